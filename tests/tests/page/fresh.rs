//! The page beside the demo, on this machine, in real time.

use std::net::SocketAddr;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use clearway_tools::demo::report::{DemoReport, DemoSummary};
use clearway_tools::demo::sensors::DemoSensors;
use clearway_tools::demo::{DemoEndpoints, DemoOptions, demo};

use crate::page::webdriver::Browser;

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

/// Returns the number of pixels on the map in the colour of safe paths.
const PATH_PIXELS: &str = "const map = document.getElementById('map');
    const { data } = map.getContext('2d').getImageData(0, 0, map.width, map.height);
    let count = 0;
    for (let i = 0; i < data.length; i += 4) if (data[i] === 255 && data[i + 1] === 225 && data[i + 2] === 77) count++;
    return count";

const AGES: &str = "const sorted = window.ages.toSorted((a, b) => a - b);
    return [0.5, 0.9, 0.99].map((share) => sorted[Math.floor(share * (sorted.length - 1))])";

pub fn the_page_shows_a_fresh_map() {
    let seconds = std::env::var("CLEARWAY_PAGE_SECONDS").ok();
    let fresh_percent_min = if seconds.is_some() { FRESH_PERCENT_MIN } else { 1 };
    let seconds: u64 = seconds.map_or(30, |text| text.parse().expect("CLEARWAY_PAGE_SECONDS is a number"));
    let looks = LOOKS_MIN.max(seconds / LOOK_EVERY_S);
    let demo = RunningDemo::start(DemoSensors::Auto);
    let browser = Browser::start(1440, 900);
    browser.open(&format!("http://{}/", demo.page));
    // With one vehicle the page opens on it.
    browser.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    assert!(browser.url().ends_with("/?vehicle=car"), "{}", browser.url());
    std::thread::sleep(SETTLE);
    browser.collect_ages();
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
    println!("age by display frame, p50, p90, p99: {} ms", browser.run(AGES));
    browser.screenshot("vehicle-1440x900");
    // Safe paths are drawn if the reader wants them.
    assert_eq!(browser.run(PATH_PIXELS), 0);
    browser.run("document.querySelector('[data-part=safe_points]').click()");
    browser.until("safe paths", &format!("const n = (() => {{ {PATH_PIXELS} }})(); return n > 0"));
    browser.run("document.querySelector('[data-part=safe_points]').click()");
    browser.until("no safe paths", &format!("const n = (() => {{ {PATH_PIXELS} }})(); return n === 0"));
    each_layer_can_be_shown(&browser);
    let errors = browser.console_errors();
    drop(browser);
    looks_well_on_a_phone(&demo);
    println!("{}", demo.stop().text());
    assert_eq!(errors, Vec::<String>::new(), "the console has no errors");
    assert!(100 * fresh >= fresh_percent_min * looks, "fresh in {fresh} of {looks} looks");
}

/// Each layer by its key, each channel as a heat map, one layer over another, and the colours by meaning.
fn each_layer_can_be_shown(browser: &Browser) {
    let legend = "return [...document.querySelectorAll('.legend li')].map((entry) => entry.textContent).join()";
    for (key, class) in [(2, "obstacle"), (3, "flat inferred"), (4, "occluded"), (5, "passable"), (6, "free")] {
        browser.key("body", &key.to_string());
        browser.until(class, &format!("{}.includes({class:?})", legend.replace("return ", "return (") + ")"));
    }
    browser.key("body", "3");
    browser.until("roughness", "return Boolean(document.querySelector('[data-part=channel] [value=roughness]'))");
    browser.run(
        "const channel = document.querySelector('[data-part=channel]');
        channel.value = 'roughness'; channel.dispatchEvent(new Event('change'))",
    );
    browser.until("a colour bar", "return !document.querySelector('[data-part=scale]').hidden");
    browser.run("document.querySelectorAll('.layer input[type=checkbox]')[3].click()");
    browser.run("document.querySelector('[data-part=by_meaning]').click()");
    browser.screenshot("roughness-under-occupancy-1440x900");
    browser.run("document.querySelectorAll('.layer input[type=checkbox]')[3].click()");
    browser.key("body", "1");
    browser.until("classes again", "return document.querySelector('[data-part=channel]').value === 'class'");
}

fn looks_well_on_a_phone(demo: &RunningDemo) {
    let phone = Browser::start_phone(390, 844);
    phone.open(&format!("http://{}/", demo.page));
    phone.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    std::thread::sleep(SETTLE);
    phone.screenshot("vehicle-390x844");
    let width = phone.run("return document.documentElement.scrollWidth");
    assert_eq!(width, 390, "nothing is wider than the phone");
    let end = phone.run("return document.querySelector('.legend').getBoundingClientRect().bottom + scrollY");
    assert!(end.as_f64().is_some_and(|end| end < 844.0), "the legend is on the first screen: {end}");
    assert_eq!(phone.console_errors(), Vec::<String>::new());
}

/// A demo in this process, on ports of the operating system's choice.
pub struct RunningDemo {
    pub page: SocketAddr,
    stop: tokio::sync::oneshot::Sender<()>,
    thread: std::thread::JoinHandle<DemoSummary>,
}

impl RunningDemo {
    pub fn start(sensors: DemoSensors) -> Self {
        let (stop, stopped) = tokio::sync::oneshot::channel();
        let (send_page, page) = mpsc::channel();
        let thread = std::thread::spawn(move || {
            let options = DemoOptions { any_port: true, sensors, ..DemoOptions::default() };
            let begun = move |endpoints: &DemoEndpoints| {
                println!("sensors: {}", endpoints.sensors);
                send_page.send(endpoints.page).expect("the test waits");
            };
            let report = |report: &DemoReport| println!("{}", report.line());
            let stopped = async {
                let _ = stopped.await;
            };
            let runtime = tokio::runtime::Runtime::new().expect("a runtime");
            runtime.block_on(demo(options, begun, report, stopped)).expect("the demo ends well")
        });
        Self { page: page.recv_timeout(START_MAX).expect("the demo starts"), stop, thread }
    }

    pub fn stop(self) -> DemoSummary {
        self.stop.send(()).expect("the demo still runs");
        self.thread.join().expect("the demo ends well")
    }
}
