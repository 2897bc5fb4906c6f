//! The page beside a replay of the golden recording: its maps stand still when the test wants it.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

use clearway_client::test::{Replay, town};
use clearway_client::{Client, MapView};
use clearway_proto::v1;

use crate::page::webdriver::Browser;

/// Chooses every layer: the first as the shown one, all others over it.
const ALL_LAYERS: &str = "document.querySelector('.layer input[type=radio]').click();
    for (const box of document.querySelectorAll('.layer input[type=checkbox]:not(:checked):enabled')) box.click()";
/// The values of the cell under the cursor: [[layer, cell, values by channel]].
const CELL: &str = "return [...document.querySelectorAll('#cell [data-layer]')].map(({ dataset }) =>
    [dataset.layer, Number(dataset.cell), { ...dataset }])";
/// Sequence of the map whose cell is shown.
const SEQUENCE: &str = "return document.getElementById('cell').dataset.sequence";

/// Runs `test` with a browser beside a replay.
fn beside_a_replay(test: impl AsyncFnOnce(&Browser, &Client)) {
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let replay = Replay::start(town()).expect("the replay starts");
        let client = replay.client().await.expect("gRPC answers");
        let browser = Browser::start(1440, 900);
        browser.open(&replay.page);
        browser.until("the time bar", "return !document.getElementById('replay').hidden");
        test(&browser, &client).await;
        assert_eq!(browser.console_errors(), Vec::<String>::new());
    });
}

/// Stops the replay at this many seconds from its begin; returns the map of that moment.
async fn stop_at(client: &Client, seconds: f64) -> MapView {
    let state = client.replay_control(v1::ReplayControl::default()).await.expect("a state");
    let seek_ns = Some(state.begin_ns + (seconds * 1e9) as i64);
    let control = v1::ReplayControl { paused: Some(true), seek_ns, ..v1::ReplayControl::default() };
    client.replay_control(control).await.expect("it stops there");
    client.newest("", &[]).await.expect("a map")
}

/// Waits until the page shows this map.
fn await_map(browser: &Browser, sequence: u64) {
    let shown = "document.querySelector('#stream dd')?.textContent";
    browser.until("the map", &format!("return {shown} === '{sequence}'"));
}

pub fn cells_are_those_of_the_client() {
    beside_a_replay(async |browser, client| {
        browser.until("layers", "return document.querySelectorAll('.layer').length === 7");
        browser.run(ALL_LAYERS);
        let map = stop_at(client, 0.5).await;
        assert_eq!(map.layers().len(), 7);
        await_map(browser, map.sequence());
        let mut compared = 0;
        // From the vehicle: one cell, then ten ahead, then to the left and the right of it.
        for keys in ["\u{e013}", "\u{e008}\u{e013}\u{e008}", "\u{e012}\u{e012}\u{e012}", "\u{e008}\u{e014}\u{e008}"] {
            browser.key("#map", keys);
            browser.until("the cell of this map", &format!("{SEQUENCE} === '{}'", map.sequence()));
            let at = "return document.querySelector('#cell p').textContent.match(/x (-?[0-9.]+) m, y (-?[0-9.]+)/)
                .slice(1).map(Number)";
            // The page answers a move of the cursor with the next message of its worker.
            let expected = [1.0, 11.0, 11.0, 11.0][compared / 7];
            browser.until("the cursor's place", &format!("const [x] = (() => {{ {at} }})(); return x === {expected}"));
            let left = [0.0, 0.0, 3.0, -7.0][compared / 7];
            browser.until("the cursor's place", &format!("const [, y] = (() => {{ {at} }})(); return y === {left}"));
            let shown = browser.run(CELL);
            let shown = shown.as_array().expect("a list");
            assert_eq!(shown.len(), 7, "{shown:?}");
            for entry in shown {
                let name = entry[0].as_str().expect("a name");
                let layer = map.layer(name).expect("a layer of the map");
                let cell = layer.grid.cell_at(expected, left);
                assert_eq!(entry[1].as_i64(), Some(cell.map_or(-1, |cell| cell as i64)), "{name}: {entry}");
                let Some(cell) = cell else { continue };
                for channel in &layer.channels {
                    let raw = entry[2][format!("raw_{}", channel.name)].as_str().expect("a value");
                    let expected = channel.cells.get(cell).expect("a cell").to_string();
                    assert_eq!(raw, expected, "{name} {}: {entry}", channel.name);
                }
                compared += 1;
            }
        }
        assert_eq!(compared, 28);
        browser.screenshot("replay-1440x900");
    });
}

/// Number of pixels of the map in the colour of plans.
const PLAN_PIXELS: &str = "const map = document.getElementById('map');
    const { data } = map.getContext('2d').getImageData(0, 0, map.width, map.height);
    let pixels = 0;
    for (let i = 0; i < data.length; i += 4) {
        if (data[i] === 255 && data[i + 1] === 79 && data[i + 2] === 216) pixels++;
    }
    return pixels";

pub fn a_plan_is_drawn() {
    beside_a_replay(async |browser, client| {
        let map = stop_at(client, 0.5).await;
        await_map(browser, map.sequence());
        assert_eq!(browser.run(PLAN_PIXELS), 0, "no plan was sent");
        let plan = v1::Plan {
            footprint_m: vec![2.0, 1.0, -2.0, 1.0, -2.0, -1.0, 2.0, -1.0],
            goal: Some(v1::PlanGoal { x: 30.0, y: 8.0 }),
            text: "blocked by a wall".into(),
            ..map.plan("tester", &[[0.0, 0.0], [10.0, 0.0], [20.0, 6.0]])
        };
        client.send_plan(&plan).await.expect("it is taken");
        browser.click("[data-part=step]");
        await_map(browser, map.sequence() + 1);
        browser.until("the plan", &format!("const pixels = (() => {{ {PLAN_PIXELS} }})(); return pixels > 100"));
        browser.until(
            "its words",
            "return document.querySelector('[data-part=legend]').textContent.includes('plan tester: blocked by a wall')",
        );
        browser.screenshot("plan-1440x900");
        stop_at(client, 0.1).await;
    });
}

pub fn the_time_bar_controls_a_replay() {
    beside_a_replay(async |browser, client| {
        let first = stop_at(client, 0.3).await;
        await_map(browser, first.sequence());
        browser.until("a pause", "return document.querySelector('[data-part=play]').textContent === 'Play'");
        browser.click("[data-part=step]");
        await_map(browser, first.sequence() + 1);
        browser.run(
            "const bar = document.querySelector('[data-part=position]');
            bar.value = 0.8; bar.dispatchEvent(new Event('input')); bar.dispatchEvent(new Event('change'))",
        );
        browser.until(
            "the map of that moment",
            "return document.querySelector('[data-part=time]').textContent.startsWith('0.8 ') &&
                Number(document.querySelector('#stream dd')?.textContent) >= 7",
        );
        browser.run(
            "const rate = document.querySelector('[data-part=rate]');
            rate.value = '2'; rate.dispatchEvent(new Event('change'))",
        );
        let mut state = client.replay_control(v1::ReplayControl::default()).await.expect("a state");
        for _ in 0..200 {
            if state.rate == 2.0 {
                break;
            }
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
            state = client.replay_control(v1::ReplayControl::default()).await.expect("a state");
        }
        assert_eq!(state.rate, 2.0);
    });
}

/// Ends `clearway view` when it is dropped.
struct Viewing(Child);

impl Drop for Viewing {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Runs `test` with a browser beside `clearway view`.
fn beside_a_view(arguments: &[&str], test: impl FnOnce(&Browser)) {
    let mut command = Command::new(clearway_tests::binaries().join("clearway"));
    command.arg("view").arg(town()).args(arguments).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut viewing = Viewing(command.spawn().expect("the command starts"));
    let mut page = String::new();
    BufReader::new(viewing.0.stdout.take().expect("a pipe")).read_line(&mut page).expect("an address");
    let browser = Browser::start(1440, 900);
    browser.open(page.trim());
    browser.until("the time bar", "return !document.getElementById('replay').hidden");
    test(&browser);
    assert_eq!(browser.console_errors(), Vec::<String>::new());
}

pub fn a_viewed_drive_opens_at_its_first_map() {
    beside_a_view(&[], |browser| {
        let legend = |words: &str| {
            let script = "return document.querySelector('.legend').textContent.includes('WORDS')";
            browser.until(words, &script.replace("WORDS", words));
        };
        legend("not reached");
        let begin = "return document.querySelector('[data-part=time]').textContent.startsWith('0.')";
        browser.until("the begin", begin);
        let is_ok = "return document.getElementById('state').textContent === 'OK'";
        browser.until("no warning of a pause that the user asked for", is_ok);
        browser.key("body", "3");
        legend("flat inferred");
        browser.click("#space-button");
        let in_3d = "return /cells (in|lie)/.test(document.getElementById('space-text').textContent)";
        browser.until("the map in 3-D", in_3d);
        let words = "return document.querySelector('.legend button').title";
        let unknown = "No point fell into the cell, or too few to judge it, and it lies in no flat region. \
                       A planner may not drive there.";
        assert_eq!(browser.run(words), unknown);
        browser.key("body", "?");
        browser.until("the keys", "return document.getElementById('keys').open");
        browser.screenshot("keys-1440x900");
    });
}

pub fn a_viewed_drive_steps() {
    beside_a_view(&["--from", "0.45"], steps);
}

fn steps(browser: &Browser) {
    browser.until("a pause", "return document.querySelector('[data-part=play]').textContent === 'Play'");
    browser.until("a map", "return /^\\d+$/.test(document.querySelector('#stream dd')?.textContent)");
    let first: u64 = browser.text("#stream dd").parse().expect("a sequence");
    browser.click("[data-part=step]");
    await_map(browser, first + 1);
    let shown = "return [document.body.dataset.map, document.getElementById('freshness').textContent,
        document.getElementById('stale').textContent]";
    browser.until("the state", "return document.body.dataset.map === 'recorded'");
    assert_eq!(browser.run(shown), serde_json::json!(["recorded", "RECORDED", ""]));
    browser.run(ALL_LAYERS);
    browser.click("[data-part=step]");
    await_map(browser, first + 2);
    browser.screenshot("view-1440x900");
}
