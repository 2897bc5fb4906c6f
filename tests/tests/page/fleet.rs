//! The page of one vehicle that stops, of a server that goes and comes back, and of fifty vehicles. The vehicles send
//! scans and poses over gRPC, which costs little: their maps are made of a few thousand points, once or more a second.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use clearway_client::{Client, Observation, now_ns};
use clearway_daemon::config::Config;
use clearway_daemon::run::{Running, Server, Setup};
use clearway_daemon::status::{State, Transport};
use tokio::runtime::Runtime;

use crate::fixture::until;
use crate::page::webdriver::Browser;

const VEHICLES: usize = 50;
/// Fifty vehicles send once a second, and the browser takes most of the machine.
const VALID_MS: u32 = 5000;
/// A name that would be markup.
const MARKUP: &str = "<img src=x onerror=\"document.title='taken'\"> & co";

/// A server with these vehicles, without other sources than gRPC.
fn config(names: &[String], page: SocketAddr) -> Config {
    let mut config = Config::of_one_vehicle(&names[0], "top");
    let any = "127.0.0.1:0".parse().expect("an address");
    (config.grpc.listen, config.page.listen) = (any, page);
    config.page.enabled = true;
    config.zenoh.enabled = false;
    config.vehicles[0].udp = None;
    config.vehicles[0].sensors[0].extrinsics.z_m = SENSOR_M;
    let first = config.vehicles[0].clone();
    config.vehicles = names
        .iter()
        .map(|name| {
            let mut vehicle = first.clone();
            vehicle.name.clone_from(name);
            vehicle
        })
        .collect();
    config
}

async fn serve(names: &[String], page: SocketAddr) -> Running {
    let setup = Setup { config: config(names, page), ..Setup::default() };
    Server::start(setup).await.expect("the server starts")
}

fn any() -> SocketAddr {
    "127.0.0.1:0".parse().expect("an address")
}

/// Height of the sensor over the ground, and of the walls, in metres.
const SENSOR_M: f64 = 1.9;
const WALL_M: f64 = 3.0;

/// Points and their rings of 16 lasers in a street with walls to both sides and one ahead, in the sensor's frame. The
/// street differs from vehicle to vehicle.
fn street(number: usize) -> ([Vec<f32>; 3], Vec<u16>) {
    let (ahead_m, right_m) = (14.0 + (number % 10) as f64, 6.0 + (number % 4) as f64);
    let (mut points, mut rings) = ([const { Vec::new() }; 3], Vec::new());
    for azimuth in (0..720).map(|half| (f64::from(half) * 0.5).to_radians()) {
        let (sin, cos) = azimuth.sin_cos();
        let side_m = if sin > 0.0 { 7.0 / sin } else { -right_m / sin };
        let wall_m = if cos > 0.0 { side_m.min(ahead_m / cos) } else { side_m };
        for ring in 0..16_u16 {
            let slope = (f64::from(ring) * 2.0 - 15.0).to_radians().tan();
            let ground_m = if slope < 0.0 { -SENSOR_M / slope } else { f64::INFINITY };
            let range_m = ground_m.min(wall_m);
            if range_m < 80.0 && SENSOR_M + range_m * slope < WALL_M {
                let point = [range_m * cos, range_m * sin, range_m * slope];
                points.iter_mut().zip(point).for_each(|(axis, value)| axis.push(value as f32));
                rings.push(ring);
            }
        }
    }
    (points, rings)
}

/// Vehicles that drive until they are told to halt, in a thread of their own.
struct Driving {
    halt: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Driving {
    /// Each vehicle sends its pose and a scan every `period`.
    fn start(running: &Running, names: &[String], period: Duration) -> Self {
        let halt = Arc::new(AtomicBool::new(false));
        let (address, names) = (running.grpc.expect("gRPC").to_string(), names.to_vec());
        let halted = halt.clone();
        let thread = std::thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
            runtime.block_on(async {
                let client = Client::connect(&address).await.expect("gRPC answers");
                let drives =
                    names.iter().enumerate().map(|(number, name)| drive(&client, name, number, period, &halted));
                futures::future::join_all(drives).await;
            });
        });
        Self { halt, thread }
    }

    fn halt(self) {
        self.halt.store(true, Ordering::Relaxed);
        self.thread.join().expect("they drive without a fault");
    }
}

async fn drive(client: &Client, name: &str, number: usize, period: Duration, halt: &AtomicBool) {
    let mut ingester = client.ingest(name).await.expect("a stream");
    let ([x, y, z], rings) = street(number);
    // Not all at one moment.
    tokio::time::sleep(period.mul_f64((number % 10) as f64 / 10.0)).await;
    let mut every = tokio::time::interval(period);
    for step in 0_u32.. {
        every.tick().await;
        if halt.load(Ordering::Relaxed) {
            return;
        }
        let now_ns = now_ns();
        let at = [(number % 10) as f64 * 30.0 + f64::from(step) * 0.5, (number / 10) as f64 * 25.0, 0.0];
        let pose = Observation::pose(now_ns, at, [0.0, 0.0, 0.0, 1.0], number as f64 / 5.0);
        let scan = Observation::scan("top", now_ns, &x, &y, &z).rings(&rings);
        ingester.send(pose).await.expect("a stream");
        ingester.send(scan).await.expect("a stream");
    }
}

fn shows(state: &str) -> String {
    format!("return document.getElementById('freshness').textContent === {state:?}")
}

pub fn a_stopped_vehicle_is_stale() {
    Runtime::new().expect("a runtime").block_on(async {
        let names = ["car".to_owned()];
        let running = serve(&names, any()).await;
        let driving = Driving::start(&running, &names, Duration::from_millis(100));
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{}/", running.page.expect("a page")));
        browser.until("FRESH", &shows("FRESH"));
        driving.halt();
        browser.until("STALE", &shows("STALE"));
        browser.until(
            "an age of seconds",
            "return parseFloat(document.getElementById('age').textContent) >= 2 &&
            document.getElementById('age').textContent.endsWith(' s')",
        );
        let newest = running.vehicles.0[0].newest.borrow().clone().expect("a map");
        // The page and this test are on one machine, so the age by the wall clock is the true one. The page writes it
        // when it draws, a moment after which it is older.
        let end_s = newest.capture_end_ns as f64 * 1e-9;
        let shown = "parseFloat(document.getElementById('age').textContent)";
        browser.until("the true age", &format!("return Math.abs({shown} - (Date.now() / 1e3 - {end_s})) < 0.4"));
        let banner = browser.text("#stale");
        assert!(banner.starts_with("STALE · "), "{banner}");
        browser.screenshot("stale-1440x900");
        assert_eq!(browser.console_errors(), Vec::<String>::new());
        running.shutdown().await.expect("it ends well");
    });
}

pub fn a_tab_opened_late_shows_what_was() {
    Runtime::new().expect("a runtime").block_on(async {
        let (names, folder) = (["car".to_owned()], tempfile::tempdir().expect("a folder"));
        let mut config = config(&names, any());
        config.recorder.file = folder.path().join("drive.mcap");
        let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
        let mut states = running.vehicles.0[0].status.states();
        let driving = Driving::start(&running, &names, Duration::from_millis(100));
        states.wait_for(|state| *state == State::Ok).await.expect("the server runs");
        driving.halt();
        states.wait_for(|state| *state == State::Error).await.expect("the server runs");
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{}/", running.page.expect("a page")));
        let told = "return document.getElementById('changes').innerText.split('\\n')";
        browser.until("the change before the tab", &format!("{told}[0].includes('ERROR since then: ')"));
        let told = browser.run(told);
        assert!(told[0].as_str().is_some_and(|text| text.ends_with("drive.mcap")), "{told}");
        let was_well = |line: &serde_json::Value| line.as_str().is_some_and(|text| text.contains(" OK for "));
        assert!(told.as_array().is_some_and(|lines| lines.iter().any(was_well)), "{told}");
        let rates = "return document.querySelector('[data-plot=map_rate_hz]')?.hidden === false";
        browser.until("the rate of maps before the tab", rates);
        browser.run("const at = document.getElementById('grafana'); at.value = 'http://g:3000'; at.onchange()");
        let link = browser.run("return document.querySelector('#changes li a').href");
        assert!(link.as_str().is_some_and(|link| link.ends_with("&to=now&var-vehicle=car")), "{link}");
        browser.run("document.getElementById('changes').scrollIntoView()");
        browser.screenshot("history-1440x900");
        browser.click(".crumbs a");
        browser.click("#table");
        let since = "return /^[0-9]+ s$|min$/.test(document.querySelector('.card [data-part=since]')?.textContent)";
        browser.until("since when", since);
        browser.screenshot("table-1440x900");
        assert_eq!(browser.console_errors(), Vec::<String>::new());
        running.shutdown().await.expect("it ends well");
    });
}

pub fn other_servers_are_shown() {
    Runtime::new().expect("a runtime").block_on(async {
        let other_page = std::net::TcpListener::bind(any()).and_then(|port| port.local_addr()).expect("a free port");
        let start = async |name: &str, page: SocketAddr, connect: &[String]| {
            let mut config = config(&[name.to_owned()], page);
            config.page.advertise = format!("http://{page}/");
            config.zenoh.enabled = true;
            config.zenoh.listen = vec!["tcp/127.0.0.1:0".to_owned()];
            config.zenoh.connect = connect.to_vec();
            Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts")
        };
        let own = start("car", any(), &[]).await;
        let other = start("van", other_page, &own.zenoh).await;
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{}/?fleet", own.page.expect("a page")));
        let card = "document.querySelector('.card[data-vehicle^=\"van @ \"]')";
        browser.until("the other server's vehicle", &format!("return {card}?.textContent.includes('served by ')"));
        browser.until("its own vehicle", "return document.querySelector('.card[data-vehicle=car]') !== null");
        assert_eq!(browser.console_errors(), Vec::<String>::new());
        browser.click(".card[data-vehicle^=\"van @ \"]");
        browser.until("its page", "return document.getElementById('vehicle-name')?.textContent === 'van'");
        assert_eq!(browser.url(), format!("http://{other_page}/?vehicle=van"));
        other.shutdown().await.expect("it ends well");
        own.shutdown().await.expect("it ends well");
    });
}

pub fn the_recorder_is_controlled() {
    Runtime::new().expect("a runtime").block_on(async {
        let (names, folder) = (["car".to_owned()], tempfile::tempdir().expect("a folder"));
        let mut config = config(&names, any());
        config.recorder.file = folder.path().join("drive.mcap");
        let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
        let driving = Driving::start(&running, &names, Duration::from_millis(100));
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{}/", running.page.expect("a page")));
        browser.until("FRESH", &shows("FRESH"));
        let says = |part: &str, text: &str| {
            let script = "return document.querySelector('[data-recorder=PART]').textContent.startsWith('TEXT')";
            browser.until(text, &script.replace("PART", part).replace("TEXT", text));
        };
        says("state", "recording: part 1");
        browser.click("[data-recorder=split]");
        says("state", "recording: part 2");
        browser.click("[data-recorder=save]");
        says("said", "Saved ");
        let said = browser.text("[data-recorder=said]");
        let files: Vec<_> = said.trim_start_matches("Saved ").split(", ").collect();
        browser.click("[data-recorder=toggle]");
        says("state", "stopped");
        browser.screenshot("recorder-1440x900");
        browser.click("[data-recorder=toggle]");
        says("state", "recording");
        assert_eq!(browser.console_errors(), Vec::<String>::new());
        driving.halt();
        running.shutdown().await.expect("it ends well");
        assert!(files.iter().all(|file| std::path::Path::new(file).is_file()), "{files:?}");
    });
}

pub fn the_page_reconnects() {
    Runtime::new().expect("a runtime").block_on(async {
        let names = ["car".to_owned()];
        let running = serve(&names, any()).await;
        let page = running.page.expect("a page");
        let driving = Driving::start(&running, &names, Duration::from_millis(200));
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{page}/"));
        browser.until("FRESH", &shows("FRESH"));
        driving.halt();
        running.shutdown().await.expect("it ends well");
        browser.until("lost", "return document.getElementById('link').dataset.phase === 'lost'");
        browser.until("STALE", &shows("STALE"));
        let running = serve(&names, page).await;
        let driving = Driving::start(&running, &names, Duration::from_millis(200));
        browser.until("live", "return document.getElementById('link').dataset.phase === 'live'");
        browser.until("FRESH", &shows("FRESH"));
        driving.halt();
        // The attempts to connect meanwhile are errors that a browser reports by itself.
        let errors = browser.console_errors();
        let others: Vec<_> = errors.iter().filter(|error| !error.contains("WebSocket")).collect();
        assert!(others.is_empty(), "{others:?}");
        running.shutdown().await.expect("it ends well");
    });
}

pub fn fifty_vehicles_are_shown() {
    Runtime::new().expect("a runtime").block_on(async {
        let names: Vec<String> = (1..=VEHICLES).map(|number| format!("shuttle-{number}")).collect();
        let mut config = config(&names, any());
        config.vehicles.iter_mut().for_each(|vehicle| vehicle.maps.valid_ms = VALID_MS);
        let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
        let driving = Driving::start(&running, &names, Duration::from_secs(1));
        let browser = Browser::start(1440, 900);
        browser.open(&format!("http://{}/", running.page.expect("a page")));
        browser.until("all cards", &format!("return document.querySelectorAll('.card').length === {VEHICLES}"));
        let in_sight = "[...document.querySelectorAll('.card')].filter((card) =>
            card.getBoundingClientRect().top < innerHeight)";
        // The vehicle is drawn in the middle of its map.
        let all_fresh = format!(
            "const cards = {in_sight};
            const isDrawn = (map) =>
                map.getContext('2d').getImageData(map.width / 2, map.height / 2, 1, 1).data[3] > 0;
            const has = (card) => card.dataset.fresh === 'fresh' && isDrawn(card.querySelector('canvas'));
            return cards.length > 8 && cards.every(has)"
        );
        browser.until("fresh maps on the cards in sight", &all_fresh);
        // Only the cards in sight cost the server anything.
        let readers =
            || -> u32 { running.vehicles.0.iter().map(|of| of.status.transports.count(Transport::Page)).sum() };
        assert!((8..VEHICLES as u32 - 5).contains(&readers()), "maps of {} vehicles are sent", readers());
        browser.until("the vehicles on the map", "return !document.getElementById('where').hidden");
        browser.screenshot("fleet-1440x900");
        browser.click("#table");
        until("a table that wants no maps", || readers() == 0).await;
        browser.screenshot("fleet-table-1440x900");
        browser.click("#table");
        is_smooth(&browser);
        is_sorted_and_found(&browser);
        // One vehicle, and back.
        browser.click(".card:not([hidden])");
        browser.until("one vehicle", "return document.body.dataset.view === 'vehicle'");
        browser.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
        assert!(browser.url().ends_with("?vehicle=shuttle-17"), "{}", browser.url());
        browser.click(".crumbs a");
        browser.until("the fleet", "return document.body.dataset.view === 'fleet'");
        a_name_with_markup_is_a_text(&browser);
        assert_eq!(browser.console_errors(), Vec::<String>::new());
        drop(browser);
        let phone = Browser::start_phone(390, 844);
        phone.open(&format!("http://{}/?fleet", running.page.expect("a page")));
        phone.until("fresh maps on the cards in sight", &all_fresh.replace("> 8", "> 1"));
        phone.screenshot("fleet-390x844");
        assert_eq!(phone.run("return document.documentElement.scrollWidth"), 390, "nothing is wider than the phone");
        drop(phone);
        driving.halt();
        running.shutdown().await.expect("it ends well");
    });
}

/// Our server refuses such a name. The page relies on none: this is the status of another server.
fn a_name_with_markup_is_a_text(browser: &Browser) {
    let name = serde_json::json!(MARKUP);
    let text = browser.run(&format!(
        "return (async () => {{
            const {{ FleetView }} = await import('/fleet/fleet.js');
            const {{ VehicleView }} = await import('/vehicle/vehicle.js');
            const settings = {{ order: 'name', only: 'all', overlays: [] }};
            window.fetch = async () => null;
            const clock = {{ now_ns: () => null, ahead_ms: () => null }};
            const status = {{ name: {name}, layers: [{name}], state: 'error', reasons: [{name}] }};
            document.getElementById('cards').replaceChildren();
            const fleet = new FleetView(() => {{}}, clock, settings, () => {{}});
            fleet.open();
            fleet.status([status], 0);
            const view = new VehicleView(() => {{}}, clock, settings, () => {{}});
            view.open(status.name);
            view.status(status, 0);
            view.refuse(status.name);
            const card = document.querySelector('.card');
            return [card.querySelector('strong'), card.querySelector('[data-part=reasons]'),
                document.getElementById('vehicle-name'), document.querySelector('.layer span'),
                document.getElementById('refusal')].map((element) => element.textContent);
        }})()"
    ));
    assert_eq!(text, serde_json::json!(vec![MARKUP; 5]));
    assert_eq!(browser.run("return document.querySelectorAll('main img').length"), 0);
    assert_ne!(browser.run("return document.title"), "taken");
}

/// Scrolls from the first card to the last, and prints the time between display frames: a figure to look at, because
/// the machine does other things as well.
fn is_smooth(browser: &Browser) {
    browser.run(
        "window.gaps = []; let before = performance.now(), top = 0;
        const step = (now) => {
            window.gaps.push(now - before); before = now; top += 25; scrollTo(0, top);
            if (window.gaps.length < 120) requestAnimationFrame(step);
        };
        requestAnimationFrame(step)",
    );
    browser.until("120 frames", "return window.gaps.length >= 120");
    let gaps = browser.run("const sorted = window.gaps.toSorted((a, b) => a - b); return [sorted[60], sorted[118]]");
    println!("display frames while scrolling, p50 and p99: {gaps} ms");
    browser.run("scrollTo(0, 0)");
}

fn is_sorted_and_found(browser: &Browser) {
    browser.run("const order = document.getElementById('order'); order.value = 'name'; order.onchange()");
    let shown = "[...document.querySelectorAll('.card:not([hidden]) strong')].map((e) => e.textContent)";
    let first = browser.run(&format!("return {shown}.slice(0, 4)"));
    assert_eq!(
        first,
        serde_json::json!(["shuttle-1", "shuttle-2", "shuttle-3", "shuttle-4"]),
        "numbers count as numbers"
    );
    browser.run("const order = document.getElementById('order'); order.value = 'speed'; order.onchange()");
    browser.run("const find = document.getElementById('find'); find.value = 'SHUTTLE-17'; find.oninput()");
    assert_eq!(browser.run(&format!("return {shown}")), serde_json::json!(["shuttle-17"]));
}
