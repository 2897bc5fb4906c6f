//! The status of a vehicle over gRPC and HTTP, and its metrics, alerts and dashboard as Prometheus' own tools see them.

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};

use clearway_daemon::run::{Server, Setup};
use clearway_proto::v1;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use crate::fixture::{Driving, before_another_look, config, feed, grpc, readings, start, within};

/// Sends a plain HTTP request; returns its status line and its body.
async fn ask(address: std::net::SocketAddr, path: &str) -> (String, String) {
    let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    within("an answer", stream.read_to_end(&mut answer)).await.unwrap();
    let answer = String::from_utf8(answer).unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.lines().next().unwrap().to_owned(), body.to_owned())
}

/// Runs promtool with this input; panics with what it says if it is not content.
fn promtool(arguments: &[&str], input: &str) {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/prometheus");
    let mut tool = Command::new("promtool");
    tool.args(arguments).current_dir(folder).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut tool = tool.spawn().unwrap();
    tool.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
    let output = tool.wait_with_output().unwrap();
    let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    // `check metrics` has an exit code for errors alone, and prints a line for each thing that is not as it should be.
    assert!(output.status.success() && (arguments[1] != "metrics" || said.is_empty()), "{arguments:?}: {said}{input}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_that_never_had_a_packet_is_alive_not_ready_and_says_why() {
    let mut config = config();
    config.page.enabled = true;
    let running = start(config).await;
    let page = running.page.unwrap();
    assert_eq!(ask(page, "/healthz").await, ("HTTP/1.1 200 OK".to_owned(), "ok\n".to_owned()));
    let (head, body) = ask(page, "/readyz").await;
    assert!(
        head.starts_with("HTTP/1.1 503") && body.starts_with("not ready\nvehicle car: no packets "),
        "{head} {body}"
    );

    let mut client = grpc(&running).await;
    let mut updates = client.watch_status(v1::WatchStatusRequest::default()).await.unwrap().into_inner();
    let first = within("a status", updates.message()).await.unwrap().unwrap().vehicles.remove(0);
    assert_eq!((first.name.as_str(), first.state.as_str(), first.map_age_ms), ("car", "error", None));
    assert!(first.reasons[0].starts_with("no packets "), "{:?}", first.reasons);

    let maps = feed(&running, readings(3)).await;
    let newest = loop {
        let update = within("a status", updates.message()).await.unwrap().unwrap();
        assert!(update.sent_ns > 0);
        match update.vehicles.into_iter().next().unwrap() {
            vehicle if vehicle.maps == maps => break vehicle,
            _ => continue,
        }
    };
    let is_replayed = newest.reasons.iter().any(|reason| reason.starts_with("maps are replayed with the stamps "));
    assert!(is_replayed, "{:?}", newest.reasons);
    assert!(newest.map_bytes > 0.0 && newest.map_rate_hz > 0.0, "{newest:?}");
    assert!(newest.latency_ms["map"] > 0.0 && newest.latency_ms["encode"] > 0.0, "{:?}", newest.latency_ms);
    // No more maps come.
    let stale = |vehicle: &v1::Vehicle| vehicle.reasons.iter().any(|reason| reason.starts_with("the newest map is "));
    within("an error", async {
        loop {
            let vehicle = updates.message().await.unwrap().unwrap().vehicles.remove(0);
            if vehicle.state == "error" && stale(&vehicle) {
                break;
            }
        }
    })
    .await;
    let (_, body) = ask(page, "/vehicles").await;
    let json: serde_json::Value = serde_json::from_str(&body).unwrap();
    assert_eq!(json[0]["state"], "error");
    assert_eq!(json[0]["readers"]["ros"], 0);
    assert_eq!(json[0]["pose"], serde_json::Value::Null);

    let refused = client.watch_status(v1::WatchStatusRequest { vehicles: vec!["bus".into()] }).await.unwrap_err();
    assert!(refused.message().contains("bus") && refused.message().contains("car"), "{refused}");
    drop(updates);
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_promtool), ignore = "needs promtool: apt-get install prometheus")]
async fn promtool_finds_nothing_wrong_with_the_metrics_of_a_server() {
    let mut config = config();
    config.page.enabled = true;
    let running = start(config).await;
    for _ in 0..2 {
        let (_, metrics) = ask(running.page.unwrap(), "/metrics").await;
        promtool(&["check", "metrics"], &metrics);
        feed(&running, readings(2)).await;
    }
    running.shutdown().await.unwrap();
}

#[test]
#[cfg_attr(not(clearway_promtool), ignore = "needs promtool: apt-get install prometheus")]
fn every_alert_is_sound_fires_and_clears() {
    promtool(&["check", "config", "prometheus.yml"], "");
    promtool(&["check", "rules", "alerts.yml"], "");
    promtool(&["test", "rules", "alerts.test.yml"], "");
    let read = |file: &str| {
        std::fs::read_to_string(format!("{}/../deploy/prometheus/{file}", env!("CARGO_MANIFEST_DIR"))).unwrap()
    };
    let (rules, tests, runbook) = (read("alerts.yml"), read("alerts.test.yml"), read("RUNBOOK.md"));
    let alerts: Vec<_> = rules.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")).collect();
    assert!(alerts.len() >= 10, "{alerts:?}");
    for alert in alerts {
        assert_eq!(tests.matches(&format!("alertname: {alert}\n")).count(), 3, "{alert}: before, firing, cleared");
        assert_eq!(runbook.matches(&format!("| `{alert}` |")).count(), 1, "{alert} has a line in the runbook");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_dashboard_and_the_alerts_use_metrics_that_a_server_has() {
    let (mut config, folder) = (config(), tempfile::tempdir().unwrap());
    config.page.enabled = true;
    config.recorder.file = folder.path().join("car.mcap");
    let running = start(config).await;
    feed(&running, readings(3)).await;
    let (_, metrics) = ask(running.page.unwrap(), "/metrics").await;
    running.shutdown().await.unwrap();
    for file in ["grafana/clearway.json", "prometheus/alerts.yml"] {
        let file = format!("{}/../deploy/{file}", env!("CARGO_MANIFEST_DIR"));
        let text = std::fs::read_to_string(&file).unwrap();
        let words = text.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
        let used: std::collections::BTreeSet<_> =
            words.filter(|word| word.starts_with("clearway_") || word.starts_with("process_")).collect();
        // Of a sensor that has seen its ground, and of a server with certificates.
        let others = ["clearway_mount_", "clearway_certificate_"];
        for name in used.iter().filter(|name| !others.iter().any(|other| name.starts_with(other))) {
            let is_there = metrics.lines().any(|line| line.split(['{', ' ']).next() == Some(*name));
            assert!(is_there, "{file}: {name} is no metric: {metrics}");
        }
        assert!(used.len() >= 8, "{used:?}");
    }
    // Without it Prometheus has no quantile.
    let types = metrics.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.strip_suffix(" histogram"));
    let is_of = |line: &str, name: &str| line.strip_prefix(name).is_some_and(|rest| rest.starts_with("_bucket{"));
    let has_rest = |name: &str| metrics.lines().any(|line| is_of(line, name) && line.contains("le=\"+Inf\""));
    assert!(types.clone().count() >= 2 && types.clone().all(has_rest), "{metrics}");
}

/// A running Prometheus with the configuration and the alerts of `deploy/prometheus`, faster by far.
struct Prometheus {
    process: std::process::Child,
    address: std::net::SocketAddr,
    _folder: tempfile::TempDir,
}

impl Prometheus {
    /// Starts a Prometheus that scrapes this address.
    fn scraping(target: std::net::SocketAddr) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let copy = |file: &str, change: &dyn Fn(&str) -> String| {
            let of = format!("{}/../deploy/prometheus/{file}", env!("CARGO_MANIFEST_DIR"));
            std::fs::write(folder.path().join(file), change(&std::fs::read_to_string(of).unwrap())).unwrap();
        };
        copy("prometheus.yml", &|text| text.replace("127.0.0.1:8080", &target.to_string()).replace("5s", "1s"));
        let at_once = |line: &str| if line.trim().starts_with("for: ") { "        for: 1s\n" } else { line }.to_owned();
        copy("alerts.yml", &|text| text.split_inclusive('\n').map(at_once).collect());
        let mut command = Command::new("prometheus");
        command.args(["--config.file=prometheus.yml", "--storage.tsdb.path=data", "--web.listen-address=127.0.0.1:0"]);
        command.current_dir(folder.path()).stderr(Stdio::piped());
        let mut process = command.spawn().unwrap();
        let mut log = std::io::BufReader::new(process.stderr.take().unwrap());
        let address = loop {
            let mut line = String::new();
            assert!(log.read_line(&mut line).unwrap() > 0, "Prometheus has ended");
            if let Some((_, address)) = line.split_once("msg=\"Listening on\" address=") {
                break address.trim().parse().unwrap();
            }
        };
        // Reads on, so that the log never blocks.
        std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::sink()));
        Self { process, address, _folder: folder }
    }

    /// Waits until this alert is as `fires` says, as Prometheus knows it.
    async fn wait_until(&self, alert: &str, fires: bool) {
        within(alert, async {
            loop {
                let (_, body) = ask(self.address, "/api/v1/alerts").await;
                let json: serde_json::Value = serde_json::from_str(&body).unwrap_or_default();
                let alerts = json["data"]["alerts"].as_array().cloned();
                let is_firing = |alerts: Vec<serde_json::Value>| {
                    alerts.iter().any(|of| of["labels"]["alertname"] == alert && of["state"] == "firing")
                };
                if alerts.map(is_firing) == Some(fires) {
                    break;
                }
                before_another_look().await;
            }
        })
        .await;
    }
}

impl Drop for Prometheus {
    fn drop(&mut self) {
        // An error means that it has ended.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_promtool), ignore = "needs Prometheus: apt-get install prometheus")]
async fn a_real_prometheus_sees_alerts_fire_and_clear_as_a_vehicle_comes_and_a_server_goes() {
    let mut config = config();
    config.page.enabled = true;
    let running = Server::start(Setup { config: config.clone(), ..Setup::default() }).await.unwrap();
    config.page.listen = running.page.unwrap();
    let prometheus = Prometheus::scraping(config.page.listen);
    prometheus.wait_until("ClearwayNoMaps", true).await;
    let driving = Driving::to(&running);
    prometheus.wait_until("ClearwayNoMaps", false).await;
    prometheus.wait_until("ClearwaySensorSilent", false).await;
    let (_, body) = ask(prometheus.address, "/api/v1/query?query=clearway_map_age_seconds").await;
    let json: serde_json::Value = serde_json::from_str(&body).unwrap();
    assert_eq!(json["data"]["result"][0]["metric"]["vehicle"], "car", "{body}");
    driving.halt();
    prometheus.wait_until("ClearwayServerDown", false).await;
    running.shutdown().await.unwrap();
    prometheus.wait_until("ClearwayServerDown", true).await;
    let running = Server::start(Setup { config, ..Setup::default() }).await.unwrap();
    prometheus.wait_until("ClearwayServerDown", false).await;
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_vehicle_in_error_does_not_cost_the_others_their_server() {
    let mut config = config();
    config.page.enabled = true;
    let mut other = config.vehicles[0].clone();
    other.name = "van".into();
    config.vehicles.push(other);
    let running = Server::start(Setup { config, ..Setup::default() }).await.unwrap();
    let page = running.page.unwrap();
    let (head, body) = ask(page, "/readyz").await;
    assert!(head.starts_with("HTTP/1.1 503") && body.lines().count() == 3, "{head} {body}");
    let driving = Driving::to(&running);
    within("the first is ready", async {
        loop {
            let (head, body) = ask(page, "/readyz").await;
            if head.starts_with("HTTP/1.1 200") {
                assert!(body.starts_with("ready\nvehicle van: no packets "), "{body}");
                break;
            }
        }
    })
    .await;
    driving.halt();
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_configuration_that_is_refused_at_sighup_is_in_status_and_metrics_until_one_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("clearway.toml");
    let mut config = config();
    config.page.enabled = true;
    std::fs::write(&file, config.to_toml()).unwrap();
    let mut server = Command::new(clearway_tests::binaries().join("clearway"));
    server.args(["serve", "--config"]).arg(&file).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut server = server.spawn().expect("clearway starts");
    let (sender, mut log) = tokio::sync::mpsc::unbounded_channel();
    let lines = BufReader::new(server.stderr.take().expect("piped")).lines().map_while(Result::ok);
    let reading = std::thread::spawn(move || lines.for_each(|line| _ = sender.send(line)));
    let mut line_with = async |text: &str| loop {
        let line = within(text, log.recv()).await.unwrap_or_else(|| panic!("the log ends without {text:?}"));
        if let Some((_, rest)) = line.split_once(text) {
            return rest.to_owned();
        }
    };
    let page = line_with("page http://").await.trim_end_matches('/').parse().expect("an address");
    let reload = |toml: &str| {
        std::fs::write(&file, toml).unwrap();
        let sent = Command::new("sh").arg("-c").arg(format!("kill -HUP {}", server.id())).status().unwrap();
        assert!(sent.success());
    };
    let is_successful = async |expected: u32| {
        let metrics = ask(page, "/metrics").await.1;
        assert!(metrics.contains(&format!("\nclearway_config_last_reload_successful {expected}\n")), "{metrics}");
    };
    let reasons = async |what: &str| {
        let text = ask(page, "/vehicles").await.1;
        assert!(text.matches("TOML parse error").count() <= 1, "a cause stands twice: {text}");
        text.contains("was not read again at the newest SIGHUP") && text.contains(what)
    };
    is_successful(1).await;
    reload(&format!("rolls = 3\n{}", config.to_toml()));
    line_with("nothing is changed").await;
    is_successful(0).await;
    assert!(reasons("rolls").await);
    reload("rolls = = 3");
    line_with("nothing is changed").await;
    assert!(reasons("TOML parse error").await);
    reload(&config.to_toml());
    line_with("are read again").await;
    is_successful(1).await;
    assert!(!reasons("").await);
    server.kill().unwrap();
    server.wait().unwrap();
    reading.join().unwrap();
}
