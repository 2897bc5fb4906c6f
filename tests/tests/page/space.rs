//! The view in 3-D beside a simulated drive.

use clearway_tools::demo::sensors::DemoSensors;

use crate::page::fresh::RunningDemo;
use crate::page::webdriver::Browser;

/// Draws the view in 3-D again, and counts the colours of its pixels in `window.colours`: they can be read only in the
/// display frame in which they are drawn.
const COUNT_COLOURS: &str = "const canvas = document.getElementById('space');
    canvas.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowLeft' }));
    canvas.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowRight' }));
    requestAnimationFrame(() => {
        const copy = new OffscreenCanvas(300, 200), pen = copy.getContext('2d');
        pen.drawImage(canvas, 0, 0, 300, 200);
        const { data } = pen.getImageData(0, 0, 300, 200);
        window.colours = Math.max(window.colours, new Set(new Uint32Array(data.buffer)).size);
    });";
/// Least number of colours of a drawn map: a canvas on which nothing is drawn has one.
const COLOURS_MIN: u32 = 100;

/// Least number of points that the page draws of a revolution.
const POINTS_MIN: u32 = 5000;

pub fn a_drive_is_shown_in_3d() {
    // The browser has no graphics card: few points and a small window leave it time to draw.
    let demo = RunningDemo::start(DemoSensors::Vlp16);
    let browser = Browser::start(1100, 700);
    browser.open(&format!("http://{}/", demo.page));
    browser.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    assert_eq!(
        browser.run("return document.getElementById('space').hidden"),
        true,
        "it is not shown before it is chosen"
    );
    open(&browser);
    colours_are_drawn(&browser);
    webgl_comes_back(&browser);
    // Points travel only when they are wanted.
    assert!(!browser.text("#space-text").contains("points"), "{}", browser.text("#space-text"));
    browser.click("#space-points");
    until_points(&browser);
    browser.screenshot("space-drivability-1100x700");
    browser.key("body", "3");
    until_legend(&browser, "flat inferred");
    browser.screenshot("space-terrain-1100x700");
    println!("{}", browser.text("#space-text"));
    browser.key("body", "4");
    // A map that comes meanwhile moves the box, and a pointer would miss it.
    browser.run("document.querySelector('[data-part=road]').click()");
    until_legend(&browser, "255 hits");
    browser.key("#space", "-");
    browser.screenshot("space-occupancy-1100x700");
    colours_are_drawn(&browser);
    close(&browser);
    let errors = browser.console_errors();
    drop(browser);
    let phone = Browser::start_phone(390, 844);
    phone.open(&format!("http://{}/", demo.page));
    phone.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    open(&phone);
    phone.run("document.getElementById('space-points').click()");
    until_points(&phone);
    phone.screenshot("space-390x844");
    is_flat_without_webgl(&demo);
    demo.stop();
    assert_eq!(errors, Vec::<String>::new(), "the console has no errors");
    assert_eq!(phone.console_errors(), Vec::<String>::new(), "the console of the phone has no errors");
}

/// Chooses the view in 3-D. A busy machine refuses WebGL at times; then the page shows the flat map and says so, and
/// the button is pressed again, as a user would.
fn open(browser: &Browser) {
    let script = "const button = document.getElementById('space-button');
        if (button.getAttribute('aria-pressed') === 'false') button.click();
        return document.getElementById('space-text').textContent.includes('terrain\\'s planes')";
    browser.until("in terrain's planes", script);
}

/// Chooses the flat map, unless WebGL was refused just now and the page already shows it.
fn close(browser: &Browser) {
    let script = "const button = document.getElementById('space-button');
        if (button.getAttribute('aria-pressed') === 'true') button.click();
        return !document.getElementById('map').hidden";
    browser.until("the flat map", script);
}

/// The browser takes WebGL away, as it does when the process of the graphics card ends, and gives it back.
fn webgl_comes_back(browser: &Browser) {
    browser.run(
        "window.lost = document.getElementById('space').getContext('webgl2').getExtension('WEBGL_lose_context');
        window.lost.loseContext()",
    );
    until_text(browser, "waiting for the browser to give WebGL back");
    browser.run("window.lost.restoreContext()");
    until_text(browser, "in terrain's planes");
    colours_are_drawn(browser);
}

/// A browser without WebGL says so, and shows the flat map.
fn is_flat_without_webgl(demo: &RunningDemo) {
    let browser = Browser::start_without_webgl(1100, 700);
    browser.open(&format!("http://{}/", demo.page));
    browser.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    browser.click("#space-button");
    until_text(&browser, "No view in 3-D: this browser gives no WebGL 2");
    assert_eq!(browser.run("return document.getElementById('map').hidden"), false);
    browser.screenshot("space-without-webgl-1100x700");
}

fn until_text(browser: &Browser, words: &str) {
    let script = format!("return document.getElementById('space-text').textContent.includes({words:?})");
    browser.until(words, &script);
}

/// Waits until points are drawn: nearly all of a revolution of a VLP-16 in a town.
fn until_points(browser: &Browser) {
    let text = "document.getElementById('space-text').textContent";
    let count = format!("Number(/· ([0-9,]+) points, dark/.exec({text})?.[1].replaceAll(',', ''))");
    browser.until("points", &format!("return {count} > {POINTS_MIN}"));
    println!("{}", browser.text("#space-text"));
}

fn until_legend(browser: &Browser, words: &str) {
    let script = format!("return document.querySelector('.legend').textContent.includes({words:?})");
    browser.until(words, &script);
}

fn colours_are_drawn(browser: &Browser) {
    browser.run("window.colours = 0");
    browser.until("a drawn map", &format!("{COUNT_COLOURS} return window.colours >= {COLOURS_MIN}"));
    println!("colours: {}", browser.run("return window.colours"));
}
