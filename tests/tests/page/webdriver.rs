//! A headless Chromium, driven through ChromeDriver by the W3C WebDriver protocol: JSON over HTTP on loopback.

use std::io::{self, BufRead, BufReader, Lines, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tempfile::TempDir;

/// A page load takes a few seconds; without a graphics card a click takes over a minute where eight others want the
/// processor. Only a browser that hangs takes longer than this.
const ANSWER_MAX: Duration = Duration::from_secs(300);
/// Longest wait for something on the page.
const PATIENCE: Duration = Duration::from_secs(300);
/// ChromeDriver is started again as often as this when the port it chose is in use.
const STARTS_MAX: usize = 10;
/// The key of an element's id in an answer (W3C WebDriver, section 12).
const ELEMENT: &str = "element-6066-11e4-a52e-4f735466cecf";
/// Chromium without a display, a graphics card, a sandbox (which root cannot have), and without traffic of its own.
const FLAGS: [&str; 8] = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
];

/// The script of [`Browser::collect_ages`].
const COLLECT_AGES: &str = "window.ages = [];
    const look = () => {
        const text = document.getElementById('age').textContent, n = parseFloat(text);
        if (!Number.isNaN(n)) window.ages.push(/ ms$/.test(text) ? n : / s$/.test(text) ? 1e3 * n : 1e6);
        requestAnimationFrame(look);
    };
    look()";

/// A browser with one window. It ends when this is dropped.
pub struct Browser {
    driver: Child,
    port: u16,
    session: String,
    /// The browser's profile, new and empty.
    profile: TempDir,
    /// The output of ChromeDriver, which a closed pipe would end.
    _output: Lines<BufReader<ChildStdout>>,
}

impl Browser {
    /// A Chromium that shows pages at this width and height.
    pub fn start(width: u32, height: u32) -> Self {
        let browser = Self::begin(width, height, json!({}), &[]);
        // The window's frame takes some of its height.
        let inner = browser.run("return [innerWidth, innerHeight]");
        let [inner_width, inner_height] = [0, 1].map(|i| inner[i].as_u64().expect("a number") as u32);
        let rect = json!({ "width": 2 * width - inner_width, "height": 2 * height - inner_height });
        browser.post(&format!("{}/window/rect", browser.session), rect);
        browser
    }

    /// A Chromium as on a phone: touch, and two pixels for each CSS pixel.
    pub fn start_phone(width: u32, height: u32) -> Self {
        let metrics = json!({ "width": width, "height": height, "pixelRatio": 2, "touch": true });
        Self::begin(width, height, json!({ "deviceMetrics": metrics }), &[])
    }

    /// A Chromium that gives a page no WebGL.
    pub fn start_without_webgl(width: u32, height: u32) -> Self {
        Self::begin(width, height, json!({}), &["--disable-3d-apis"])
    }

    /// Starts ChromeDriver and through it a Chromium with a window of this size.
    fn begin(width: u32, height: u32, mobile: Value, further_flags: &[&str]) -> Self {
        let (driver, port, output) = start_driver();
        let profile = tempfile::tempdir().expect("a folder");
        let mut browser = Self { driver, port, session: String::new(), profile, _output: output };
        let mut flags: Vec<_> = FLAGS.iter().chain(further_flags).map(|&flag| flag.to_owned()).collect();
        flags.push(format!("--user-data-dir={}", browser.profile.path().display()));
        flags.push(format!("--window-size={width},{height}"));
        let mut options = json!({ "args": flags });
        if mobile["deviceMetrics"].is_object() {
            options["mobileEmulation"] = mobile;
        }
        let session = browser.post(
            "/session",
            json!({ "capabilities": { "alwaysMatch": {
                "browserName": "chrome",
                "goog:chromeOptions": options,
                "goog:loggingPrefs": { "browser": "ALL" },
            } } }),
        );
        browser.session = format!("/session/{}", session["sessionId"].as_str().expect("a session's id"));
        browser
    }

    /// Opens a page and waits until it is loaded.
    pub fn open(&self, url: &str) {
        self.post(&format!("{}/url", self.session), json!({ "url": url }));
    }

    /// The address of the page.
    pub fn url(&self) -> String {
        self.request("GET", &format!("{}/url", self.session), None).as_str().expect("a text").to_owned()
    }

    /// Waits until a script returns true.
    pub fn until(&self, what: &str, script: &str) {
        let began = Instant::now();
        while self.run(script) != true {
            assert!(began.elapsed() < PATIENCE, "waited in vain: {what}\n{}", self.text("body"));
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Presses keys while an element has the focus.
    pub fn key(&self, selector: &str, keys: &str) {
        let element = self.find(selector);
        self.post(&format!("{}/element/{element}/value", self.session), json!({ "text": keys }));
    }

    /// Clicks the element, not the place at which it was: a new map may move it meanwhile.
    pub fn click(&self, selector: &str) {
        self.run(&format!("document.querySelector({selector:?}).click()"));
    }

    /// Keeps a picture of the window in `target/page`.
    pub fn screenshot(&self, name: &str) {
        let picture = self.request("GET", &format!("{}/screenshot", self.session), None);
        let picture = decoded_base64(picture.as_str().expect("a text"));
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/page");
        std::fs::create_dir_all(&folder).expect("a folder");
        std::fs::write(folder.join(format!("{name}.png")), picture).expect("a picture");
    }

    fn find(&self, selector: &str) -> String {
        let found =
            self.post(&format!("{}/element", self.session), json!({ "using": "css selector", "value": selector }));
        found[ELEMENT].as_str().expect("an element's id").to_owned()
    }

    /// The text of an element, as a person sees it.
    pub fn text(&self, selector: &str) -> String {
        let element = self.find(selector);
        let text = self.request("GET", &format!("{}/element/{element}/text", self.session), None);
        text.as_str().expect("a text").to_owned()
    }

    /// Runs a script in the page; returns its result.
    pub fn run(&self, script: &str) -> Value {
        self.post(&format!("{}/execute/sync", self.session), json!({ "script": script, "args": [] }))
    }

    /// Collects the age of the shown map in `window.ages`, ms, at every display frame from now on.
    pub fn collect_ages(&self) {
        self.run(COLLECT_AGES);
    }

    /// The errors in the browser's console since the last call.
    pub fn console_errors(&self) -> Vec<String> {
        let log = self.post(&format!("{}/se/log", self.session), json!({ "type": "browser" }));
        let entries = log.as_array().cloned().unwrap_or_default();
        entries.iter().filter(|entry| entry["level"] == "SEVERE").map(|entry| entry["message"].to_string()).collect()
    }

    fn post(&self, path: &str, body: Value) -> Value {
        self.request("POST", path, Some(body))
    }

    /// Sends one request; returns the value of the answer.
    fn request(&self, method: &str, path: &str, body: Option<Value>) -> Value {
        let (status, answer) = self.exchange(method, path, body).expect("chromedriver answers");
        let answer: Value = serde_json::from_slice(&answer).expect("JSON");
        assert!(status.contains(" 200 "), "{method} {path}: {status}: {}", answer["value"]);
        answer["value"].clone()
    }

    /// Sends one request; returns the status line and the body of the answer.
    fn exchange(&self, method: &str, path: &str, body: Option<Value>) -> io::Result<(String, Vec<u8>)> {
        let body = body.map_or(String::new(), |body| body.to_string());
        let mut stream = TcpStream::connect(("127.0.0.1", self.port))?;
        stream.set_read_timeout(Some(ANSWER_MAX))?;
        let (port, length) = (self.port, body.len());
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\nContent-Type: \
             application/json\r\nContent-Length: {length}\r\n\r\n{body}"
        )?;
        read_answer(&mut BufReader::new(stream))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The end of the session ends Chromium.
        let _ = self.exchange("DELETE", &self.session, None);
        let _ = self.driver.kill();
        let _ = self.driver.wait();
    }
}

/// Starts ChromeDriver; returns it with its port and the rest of its output.
///
/// On port 0 it takes a free port of `::1` and then the same port of `127.0.0.1`, and ends when a test beside this test
/// holds that port.
fn start_driver() -> (Child, u16, Lines<BufReader<ChildStdout>>) {
    for _ in 0..STARTS_MAX {
        let mut driver = Command::new("chromedriver")
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("chromedriver starts");
        let mut output = BufReader::new(driver.stdout.take().expect("stdout is piped")).lines();
        if let Some(port) = output.by_ref().map_while(Result::ok).find_map(|line| port_of(&line)) {
            return (driver, port, output);
        }
        driver.wait().expect("chromedriver ended");
    }
    panic!("chromedriver found no port in {STARTS_MAX} starts");
}

/// The port in ChromeDriver's line "ChromeDriver was started successfully on port 37669."
fn port_of(line: &str) -> Option<u16> {
    line.strip_prefix("ChromeDriver was started successfully on port ")?.trim_end_matches('.').parse().ok()
}

/// The status line and the body of an HTTP answer.
fn read_answer(stream: &mut impl BufRead) -> io::Result<(String, Vec<u8>)> {
    let mut next_line = || {
        let mut line = String::new();
        stream.read_line(&mut line).map(|_| line.trim_end().to_owned())
    };
    let status = next_line()?;
    let mut length = 0;
    loop {
        let header = next_line()?.to_ascii_lowercase();
        if header.is_empty() {
            break;
        }
        if let Some(value) = header.strip_prefix("content-length:") {
            length = value.trim().parse().map_err(io::Error::other)?;
        }
    }
    let mut body = vec![0; length];
    stream.read_exact(&mut body)?;
    Ok((status, body))
}

/// The bytes of a text in base64 (RFC 4648, section 4).
fn decoded_base64(text: &str) -> Vec<u8> {
    let value = |letter: u8| match letter {
        b'A'..=b'Z' => letter - b'A',
        b'a'..=b'z' => letter - b'a' + 26,
        b'0'..=b'9' => letter - b'0' + 52,
        b'+' => 62,
        _ => 63,
    };
    let letters: Vec<u8> = text.bytes().filter(|&letter| letter != b'=').map(value).collect();
    let bytes = letters.chunks(4).flat_map(|four| {
        let bits = four.iter().enumerate().fold(0, |bits, (i, &six)| bits | u32::from(six) << (18 - 6 * i));
        bits.to_be_bytes()[1..four.len()].to_vec()
    });
    bytes.collect()
}
