//! Recordings in a store: a folder, and a bucket of an S3-compatible server that refuses, lies and vanishes.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Output, Stdio};
use std::time::{Duration, Instant, SystemTime};

use clearway_daemon::config::{Config, Recorder};
use clearway_daemon::record::writer::{Files, Folder};
use clearway_daemon::store::index::{Entry, Search, search};
use clearway_daemon::store::{location, upload};
use clearway_tests::{binaries, workspace};
use serde_json::Value;

use crate::fixture::venv;

/// Time of the first message of the golden recording, as its capture was made.
const GOLDEN_DAY: &str = "2026-01-01";

/// A folder with these copies of the golden recording.
fn recordings(folder: &Path, names: &[&str]) -> PathBuf {
    let recordings = folder.join("recordings");
    std::fs::create_dir_all(&recordings).unwrap();
    for name in names {
        std::fs::copy(workspace().join("tests/golden/drive.mcap"), recordings.join(name)).unwrap();
    }
    recordings
}

/// Sets the time at which a file was last written to so many hours before now.
fn modified_hours_ago(file: &Path, hours: i64) {
    let (now, span) = (SystemTime::now(), Duration::from_secs(hours.unsigned_abs() * 3600));
    let time = if hours < 0 { now + span } else { now - span };
    std::fs::File::options().write(true).open(file).unwrap().set_modified(time).unwrap();
}

fn clearway(environment: &[(&str, &str)], arguments: &[&str]) -> Output {
    let mut command = Command::new(binaries().join("clearway"));
    command.envs(environment.iter().copied()).args(arguments).output().expect("the binary starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn found(environment: &[(&str, &str)], store: &str, more: &[&str]) -> usize {
    let output = clearway(environment, &[&["recordings", "--store", store, "--json"], more].concat());
    assert_eq!(output.status.code(), Some(0), "{more:?}: {}", text(&output.stderr));
    let found = serde_json::from_slice::<Value>(&output.stdout).unwrap();
    found["parts"].as_array().unwrap().len()
}

#[test]
fn a_file_that_a_recorder_writes_is_not_sent_however_long_it_has_not_changed() {
    let folder = tempfile::tempdir().unwrap();
    let options = Recorder { file: folder.path().join("parked.mcap"), ..Recorder::default() };
    let mut files = Folder::open(&options).unwrap();
    let mut being_written = files.create(1).unwrap();
    being_written.write_all(b"events").unwrap();
    modified_hours_ago(&files.path(1), 2);
    assert_eq!(upload::unconfirmed(folder.path()).unwrap(), [""; 0].map(PathBuf::from));
    // A crash ends the lock with the process. A child that another test starts has a copy of it until it runs.
    drop(being_written);
    let began = Instant::now();
    while upload::unconfirmed(folder.path()).unwrap() != [files.path(1)] {
        assert!(began.elapsed() < Duration::from_secs(60), "the file that was left is not sent");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn parts_are_found_in_a_folder_by_vehicle_time_place_and_faults() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), &["whole.mcap"]);
    let bytes = std::fs::read(recordings.join("whole.mcap")).unwrap();
    let cut = recordings.join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() - 1000]).unwrap();
    // An hour ahead of the clock, so that it is new however long this test waits for a build.
    modified_hours_ago(&cut, -1);
    let store = folder.path().join("store").display().to_string();
    let upload = || clearway(&[], &["upload", recordings.to_str().unwrap(), "--store", &store]);
    let first = upload();
    assert_eq!(first.status.code(), Some(0), "{}", text(&first.stderr));
    // The cut file may still be written, until it is old.
    assert_eq!(text(&first.stdout).lines().count(), 1, "{}", text(&first.stdout));
    modified_hours_ago(&cut, 1);
    assert_eq!(upload().status.code(), Some(0));
    assert!(upload().stdout.is_empty(), "what is confirmed is not sent again");

    assert_eq!(found(&[], &store, &[]), 2);
    // The golden drive has no ego poses, so its entries get a place here.
    assert_eq!(found(&[], &store, &["--near", "0,0"]), 0);
    let near = clearway(&[], &["recordings", "--store", &store, "--near", "0,0"]);
    assert!(text(&near.stderr).contains("2 parts left out that may be near"), "{}", text(&near.stderr));
    let near = clearway(&[], &["recordings", "--store", &store, "--near", "0,0", "--json"]);
    assert_eq!(serde_json::from_slice::<Value>(&near.stdout).unwrap()["without_place"], 2);
    let all = text(&clearway(&[], &["recordings", "--store", &store]).stdout);
    assert!(all.contains(&format!(", {GOLDEN_DAY}T12:")) && all.contains("Z to "), "{all}");
    for file in std::fs::read_dir(Path::new(&store).join("index/car")).unwrap() {
        let file = file.unwrap().path();
        let mut entry: Entry = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        entry.cells.insert((2, -1));
        std::fs::write(file, serde_json::to_vec(&entry).unwrap()).unwrap();
    }
    let [before, after] = [format!("{GOLDEN_DAY}T11:00:00Z"), format!("{GOLDEN_DAY}T13:00:00Z")];
    let searches: [(&[&str], usize); 9] = [
        (&["--vehicle", "car"], 2),
        (&["--vehicle", "bus"], 0),
        (&["--from", &before, "--to", &after], 2),
        (&["--from", &after], 0),
        (&["--to", &before], 0),
        (&["--near", "60,-10"], 2),
        (&["--near", "1000,0"], 0),
        (&["--near", "1000,0", "--within", "2000"], 2),
        (&["--faults"], 1),
    ];
    for (options, expected) in searches {
        assert_eq!(found(&[], &store, options), expected, "{options:?}");
    }
    assert_eq!(clearway(&[], &["recordings", "--store", &store, "--from", "today"]).status.code(), Some(3));
    let out = folder.path().join("out");
    let fetch = || clearway(&[], &["recordings", "--store", &store, "--faults", "--out", out.to_str().unwrap()]);
    assert_eq!(fetch().status.code(), Some(0));
    let fetched: Vec<_> = std::fs::read_dir(&out).unwrap().map(|file| file.unwrap().path()).collect();
    assert_eq!(fetched.len(), 1, "{fetched:?}");
    assert_eq!(std::fs::read(&fetched[0]).unwrap(), std::fs::read(&cut).unwrap());
    assert_eq!(fetch().status.code(), Some(2), "a file that is there is not overwritten");
    assert_eq!(found(&[], &format!("file://{store}"), &[]), 2);
    let absent = folder.path().join("absent").display().to_string();
    for (url, said) in [
        ("ftp://a/b", "a folder, file:///FOLDER and s3://BUCKET/PREFIX are allowed"),
        ("file://relative", "a folder, file:///FOLDER and s3://BUCKET/PREFIX are allowed"),
        ("s3://", "the bucket is missing"),
        (&absent, "there is no such folder"),
    ] {
        let output = clearway(&[], &["recordings", "--store", url]);
        assert_eq!(output.status.code(), Some(2), "{url}");
        assert!(text(&output.stderr).contains(said), "{}", text(&output.stderr));
    }
    assert!(!Path::new(&absent).exists(), "a search creates nothing");
}

#[tokio::test]
async fn a_part_is_deleted_only_if_it_is_the_part_that_was_confirmed() {
    let folder = tempfile::tempdir().unwrap();
    let part = recordings(folder.path(), &["drive.mcap"]).join("drive.mcap");
    let store = location::open(folder.path().join("store").to_str().unwrap()).unwrap();
    assert!(!upload::delete_confirmed(&part).unwrap(), "it is not confirmed");
    let confirmation = upload::upload(&*store, &part, None).await.unwrap();
    let expected = Entry::of_part(&part, confirmation.bytes, confirmation.crc32).unwrap();
    assert_eq!(search(&*store, &Search::default()).await.unwrap().entries, expected);
    assert_eq!((expected[0].events, expected[0].layers), (172, 21));
    // Another recording with the name of the confirmed one is another part.
    let bytes = std::fs::read(&part).unwrap();
    std::fs::write(&part, &bytes[..bytes.len() - 1]).unwrap();
    assert!(!upload::delete_confirmed(&part).unwrap() && part.exists());
    std::fs::write(&part, &bytes).unwrap();
    assert!(upload::delete_confirmed(&part).unwrap() && !part.exists());
}

/// An S3-compatible server in a process of its own.
struct S3 {
    process: Child,
    faults: ChildStdin,
    said: BufReader<ChildStdout>,
    url: String,
}

impl S3 {
    fn start() -> Self {
        let mut process = Command::new(venv::s3())
            .arg("-B")
            .arg(workspace().join("tests/python/s3_server.py"))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("python starts");
        let (faults, said) = (process.stdin.take().unwrap(), BufReader::new(process.stdout.take().unwrap()));
        let mut server = Self { process, faults, said, url: String::new() };
        server.url = server.line();
        assert!(server.url.starts_with("http://127.0.0.1:"), "{}", server.url);
        server
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.said.read_line(&mut line).unwrap();
        line.trim().to_owned()
    }

    fn fault(&mut self, fault: &str) {
        writeln!(self.faults, "{fault}").unwrap();
        assert_eq!(self.line(), fault);
    }

    fn environment(&self) -> [(&str, &str); 4] {
        [
            ("AWS_ENDPOINT_URL", &self.url),
            ("AWS_ACCESS_KEY_ID", "test"),
            ("AWS_SECRET_ACCESS_KEY", "test"),
            ("AWS_REGION", "us-east-1"),
        ]
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

#[test]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
fn a_bucket_that_refuses_lies_or_vanishes_costs_no_recording() {
    const STORE: &str = "s3://fleet/kept";
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), &["a.mcap", "b.mcap"]);
    let kept = || recordings.join("a.mcap").exists() && recordings.join("b.mcap").exists();
    let mut server = S3::start();
    let upload = |server: &S3| {
        let arguments = ["upload", recordings.to_str().unwrap(), "--store", STORE, "--delete"];
        clearway(&server.environment(), &arguments)
    };
    for (fault, said) in [("deny", "403"), ("lie", "the store confirmed the part"), ("refuse", "503")] {
        server.fault(fault);
        let output = upload(&server);
        let complained = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{fault}: {complained}");
        assert!(complained.contains("not confirmed, and kept") && complained.contains(said), "{fault}: {complained}");
        assert!(output.stdout.is_empty() && kept(), "{fault}: {}", text(&output.stdout));
    }
    server.fault("none");
    assert_eq!(found(&server.environment(), STORE, &[]), 0, "what is not confirmed has no entry");
    let output = upload(&server);
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    assert_eq!(text(&output.stdout).matches("is confirmed").count(), 2);
    assert!(std::fs::read_dir(&recordings).unwrap().next().is_none(), "both are deleted, with their confirmations");
    let options = ["--vehicle", "car", "--from", "2026-01-01T00:00:00Z"];
    assert_eq!(found(&server.environment(), STORE, &options), 1, "two names of one content are one entry");

    for url in ["s3://fleet/kept", "s3://fleet/kept/parts"] {
        let output = clearway(&server.environment(), &["verify", url, "--json"]);
        assert_eq!(output.status.code(), Some(0), "{url}: {}", text(&output.stderr));
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        let files = report["files"].as_array().unwrap();
        assert_eq!((files.len(), &files[0]["maps"]), (1, &3.into()), "{url}: {report:#}");
        assert!(files[0]["file"].as_str().unwrap().starts_with("s3://fleet/kept/parts/"), "{report:#}");
    }
    for (url, said) in [("s3://fleet/other", "no recording"), ("s3://fleet/kept/a.mcap", "s3://fleet/kept/a.mcap")] {
        let output = clearway(&server.environment(), &["verify", url]);
        assert_eq!(output.status.code(), Some(2), "{url}");
        assert!(text(&output.stderr).contains(said), "{url}: {}", text(&output.stderr));
    }

    std::fs::copy(workspace().join("tests/golden/drive.mcap"), recordings.join("c.mcap")).unwrap();
    server.process.kill().unwrap();
    server.process.wait().unwrap();
    let output = upload(&server);
    assert_eq!(output.status.code(), Some(2));
    assert!(recordings.join("c.mcap").exists(), "{}", text(&output.stderr));
}

#[test]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
fn a_server_names_a_bucket_without_rights_serves_on_and_uploads_when_it_has_them() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), &["car-1.part-0001.mcap"]);
    let mut bucket = S3::start();
    bucket.fault("deny");
    let mut config = Config::of_one_vehicle("car", "top");
    let grpc = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    (config.grpc.listen, config.page.enabled, config.zenoh.enabled) = (grpc, false, false);
    config.recorder.file = recordings.join("car.mcap");
    (config.store.url, config.store.upload_kbit_s_max) = ("s3://fleet/kept".into(), 8000);
    let file = folder.path().join("clearway.toml");
    std::fs::write(&file, config.to_toml()).unwrap();
    let mut serve = Command::new(binaries().join("clearway"));
    let serve = serve.envs(bucket.environment()).args(["serve", "--config"]).arg(&file).stderr(Stdio::null());
    let mut server = Stopped(serve.spawn().unwrap());
    let grpc = grpc.to_string();
    // The exit code says that no packet comes; the state would be the same without the store.
    let mut status = || {
        assert!(server.0.try_wait().unwrap().is_none(), "the server runs");
        text(&clearway(&[], &["status", "--server", &grpc, "--json"]).stdout)
    };
    while !status().contains("403") {}
    bucket.fault("none");
    while found(&bucket.environment(), "s3://fleet/kept", &[]) == 0 {}
    while status().contains("403") {}
}

/// A process that ends when this is dropped.
struct Stopped(Child);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
