//! A headless Chromium, driven through ChromeDriver by the W3C WebDriver protocol: JSON over HTTP on loopback.

use std::io::{self, BufRead, BufReader, Lines, Write};
use std::net::TcpStream;
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;

/// ChromeDriver answers within a page load, which takes a few seconds on a loaded machine.
const ANSWER_MAX: Duration = Duration::from_secs(60);
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
    /// Starts ChromeDriver and through it a Chromium whose window has this width and height.
    pub fn start(width: u32, height: u32) -> Self {
        let mut driver = Command::new("chromedriver")
            .arg("--port=0")
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("chromedriver starts");
        let mut output = BufReader::new(driver.stdout.take().expect("stdout is piped")).lines();
        let port = output.by_ref().map_while(Result::ok).find_map(|line| port_of(&line));
        let port = port.expect("chromedriver prints its port");
        let profile = tempfile::tempdir().expect("a folder");
        let mut browser = Self { driver, port, session: String::new(), profile, _output: output };
        let mut flags = FLAGS.map(str::to_owned).to_vec();
        flags.push(format!("--user-data-dir={}", browser.profile.path().display()));
        flags.push(format!("--window-size={width},{height}"));
        let session = browser.post(
            "/session",
            json!({ "capabilities": { "alwaysMatch": {
                "browserName": "chrome",
                "goog:chromeOptions": { "args": flags },
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

    /// The text of an element, as a person sees it.
    pub fn text(&self, selector: &str) -> String {
        let found =
            self.post(&format!("{}/element", self.session), json!({ "using": "css selector", "value": selector }));
        let element = found[ELEMENT].as_str().expect("an element's id");
        let text = self.request("GET", &format!("{}/element/{element}/text", self.session), None);
        text.as_str().expect("a text").to_owned()
    }

    /// Runs a script in the page; returns its result.
    pub fn run(&self, script: &str) -> Value {
        self.post(&format!("{}/execute/sync", self.session), json!({ "script": script, "args": [] }))
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
