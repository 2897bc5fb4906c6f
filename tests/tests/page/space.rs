//! The view in 3-D beside a simulated drive.

use clearway::cli::make::demo::sensors::Sensors;

use crate::fresh::RunningDemo;
use crate::webdriver::Browser;

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
    let demo = RunningDemo::start(Sensors::Vlp16);
    let browser = Browser::start(1100, 700);
    browser.open(&format!("http://{}/", demo.page));
    browser.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    assert_eq!(
        browser.run("return document.getElementById('space').hidden"),
        true,
        "it is not shown before it is chosen"
    );
    browser.click("#space-button");
    until_text(&browser, "in the planes of drivability's segments");
    colours_are_drawn(&browser);
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
    browser.click("[data-part=road]");
    until_legend(&browser, "255 hits");
    browser.key("#space", "-");
    browser.screenshot("space-occupancy-1100x700");
    colours_are_drawn(&browser);
    browser.click("#space-button");
    browser.until("the flat map", "return !document.getElementById('map').hidden");
    let errors = browser.console_errors();
    drop(browser);
    let phone = Browser::start_phone(390, 844);
    phone.open(&format!("http://{}/", demo.page));
    phone.until("a map", "return document.getElementById('freshness').textContent !== 'NO MAP YET'");
    phone.run("document.getElementById('space-button').click(); document.getElementById('space-points').click()");
    until_points(&phone);
    phone.screenshot("space-390x844");
    demo.stop();
    assert_eq!(errors, Vec::<String>::new(), "the console has no errors");
    assert_eq!(phone.console_errors(), Vec::<String>::new(), "the console of the phone has no errors");
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
