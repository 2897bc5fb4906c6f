//! The page in a real browser: beside the demo, on this machine, in real time, its map is fresh.
//!
//! `CLEARWAY_PAGE_SECONDS=300 cargo test --release -p clearway-tests --test page -- --nocapture` looks for five
//! minutes, 100 times, and asserts that the map is fresh in 95 of them. Without the variable the test looks 20 times,
//! and asserts that the page shows a fresh map at all and that its console has no errors: a debug build, a simulated
//! sensor and a browser on two shared cores need not keep up.

#[cfg(clearway_browser)]
mod webdriver;

#[test]
#[cfg_attr(
    not(clearway_browser),
    ignore = "needs Chromium: apt-get install chromium chromium-driver, then touch tests/build.rs"
)]
fn the_page_beside_the_demo_shows_a_fresh_map() {
    #[cfg(clearway_browser)]
    fresh::the_page_shows_a_fresh_map();
}

#[cfg(clearway_browser)]
mod fresh {
    use std::net::SocketAddr;
    use std::sync::mpsc;
    use std::time::{Duration, Instant};

    use clearway::cli::demo::report::{Report, Summary};
    use clearway::cli::demo::{Endpoints, Options, demo};

    use crate::webdriver::Browser;

    /// How long the page may take to its first map: it starts together with the car.
    const START_MAX: Duration = Duration::from_secs(30);
    /// The page's rate of maps is a mean of 3 s.
    const SETTLE: Duration = Duration::from_secs(3);
    /// Looks in the ordinary test, 1.5 s apart.
    const LOOKS_MIN: u64 = 20;
    /// From one look to the next in a longer test, in seconds.
    const LOOK_EVERY_S: u64 = 3;
    /// Share of the looks of the longer test in which the map must be fresh, in percent.
    const FRESH_PERCENT_MIN: u64 = 95;

    /// Returns the number of layers over which paths are drawn.
    const DRAWN_PATHS: &str = "return [...document.querySelectorAll('[data-part=\"paths\"]')].filter((canvas) =>
        canvas.width > 0 && canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.some(Boolean)
    ).length";

    pub fn the_page_shows_a_fresh_map() {
        let seconds = std::env::var("CLEARWAY_PAGE_SECONDS").ok();
        let fresh_percent_min = if seconds.is_some() { FRESH_PERCENT_MIN } else { 1 };
        let seconds: u64 = seconds.map_or(30, |text| text.parse().expect("CLEARWAY_PAGE_SECONDS is a number"));
        let looks = LOOKS_MIN.max(seconds / LOOK_EVERY_S);
        let demo = RunningDemo::start();
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{}/", demo.page));
        await_first_map(&browser);
        std::thread::sleep(SETTLE);
        let began = Instant::now();
        let mut fresh = 0;
        for look in 0..looks {
            let due = Duration::from_secs(seconds).mul_f64(look as f64 / looks as f64);
            std::thread::sleep(due.saturating_sub(began.elapsed()));
            let [badge, age, rate] = ["#freshness", "#age", "#rate"].map(|selector| browser.text(selector));
            println!("{:>5.1} s  {badge}  age {age}  {rate} Hz", began.elapsed().as_secs_f64());
            fresh += u64::from(badge == "FRESH");
        }
        println!("fresh in {fresh} of {looks} looks\n{}", browser.text("#stream"));
        // Safe paths are drawn over the layer that has them, and over every layer that is in sight if they are chosen.
        let drawn = browser.run(DRAWN_PATHS);
        browser.run("document.getElementById('paths').click()");
        let began = Instant::now();
        while browser.run(DRAWN_PATHS) == drawn {
            assert!(began.elapsed() < START_MAX, "paths on {drawn} of the layers in sight");
            std::thread::sleep(Duration::from_millis(100));
        }
        let errors = browser.console_errors();
        drop(browser);
        println!("{}", demo.stop().text());
        assert_eq!(errors, Vec::<String>::new(), "the console has no errors");
        assert!(100 * fresh >= fresh_percent_min * looks, "fresh in {fresh} of {looks} looks");
    }

    fn await_first_map(browser: &Browser) {
        let began = Instant::now();
        while browser.text("#freshness") == "NO MAP YET" {
            assert!(began.elapsed() < START_MAX, "no map in {START_MAX:?}: {}", browser.text("body"));
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// A demo in this process, on ports of the operating system's choice.
    struct RunningDemo {
        page: SocketAddr,
        stop: tokio::sync::oneshot::Sender<()>,
        thread: std::thread::JoinHandle<Summary>,
    }

    impl RunningDemo {
        fn start() -> Self {
            let (stop, stopped) = tokio::sync::oneshot::channel();
            let (send_page, page) = mpsc::channel();
            let thread = std::thread::spawn(move || {
                let options = Options { any_port: true, ..Options::default() };
                let begun = move |endpoints: &Endpoints| {
                    println!("sensors: {}", endpoints.sensors);
                    send_page.send(endpoints.page).expect("the test waits");
                };
                let report = |report: &Report| println!("{}", report.line());
                let stopped = async {
                    let _ = stopped.await;
                };
                let runtime = tokio::runtime::Runtime::new().expect("a runtime");
                runtime.block_on(demo(options, begun, report, stopped)).expect("the demo ends well")
            });
            Self { page: page.recv_timeout(START_MAX).expect("the demo starts"), stop, thread }
        }

        fn stop(self) -> Summary {
            self.stop.send(()).expect("the demo still runs");
            self.thread.join().expect("the demo ends well")
        }
    }
}
