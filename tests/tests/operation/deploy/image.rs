//! The container file, built on Debian's packages and started with a read-only root file system, without rights.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clearway_tests::serial::PACKAGES;
use clearway_tests::{binaries, workspace};

use super::{said, succeeds};

/// The release of Debian that the container file names.
const RELEASE: &str = "trixie";
/// Starts a program in the root `$1` as the image's user: nothing but /data can be written, no capability is left, and
/// none can be gained. `$2` is the folder of the configuration.
const START: &str = r#"set -e
mount --make-rprivate /
mount --bind "$1" "$1"
mount --bind "$2" "$1/etc/clearway"
mount -t proc proc "$1/proc"
mount -t tmpfs -o uid=10001,gid=10001,mode=700 data "$1/data"
mount -o remount,bind,ro "$1/etc/clearway"
mount -o remount,bind,ro "$1"
root=$1
shift 2
exec chroot "$root" setpriv --reuid 10001 --regid 10001 --clear-groups --no-new-privs --bounding-set=-all \
    --inh-caps=-all "$@""#;

/// The tool `buildah` with a store of its own.
struct Buildah(PathBuf);

impl Buildah {
    fn run(&self, arguments: &[&str]) -> String {
        let mut command = Command::new("buildah");
        let (root, run) = (self.0.join("store"), self.0.join("run"));
        command.args(["--storage-driver", "vfs", "--root"]).arg(root).arg("--runroot").arg(run);
        succeeds(command.args(arguments)).trim().to_owned()
    }
}

/// The image that the container file describes, with the built command in place of its first stage; returns the folder
/// of its root file system.
fn built(buildah: &Buildah) -> PathBuf {
    let base = buildah.0.join("base.tar");
    let mut debian = Command::new("mmdebstrap");
    debian.args(["--quiet", "--variant=minbase", RELEASE]).arg(&base);
    for list in ["/etc/apt/sources.list.d/debian.sources", "/etc/apt/sources.list"].map(Path::new) {
        let Some(text) = fs::read_to_string(list).ok().filter(|text| !text.is_empty()) else { continue };
        // The mirrors of this machine, whose own release may differ.
        let of_release = buildah.0.join(list.file_name().expect("it has a name"));
        fs::write(&of_release, text.replace("bookworm", RELEASE)).expect("a file of ours");
        debian.arg(of_release);
    }
    succeeds(&mut debian);
    let container = buildah.run(&["from", "scratch"]);
    buildah.run(&["add", "--quiet", &container, &base.display().to_string(), "/"]);
    buildah.run(&["commit", "--quiet", "--rm", &container, &format!("docker.io/library/debian:{RELEASE}-slim")]);

    let stage = buildah.0.join("build");
    fs::create_dir_all(stage.join("etc/ssl/certs")).expect("a folder of ours");
    let certificates = "etc/ssl/certs/ca-certificates.crt";
    fs::write(stage.join(certificates), "").expect("a file of ours");
    let command = stage.join("clearway");
    succeeds(Command::new("strip").arg("-o").arg(&command).arg(binaries().join("clearway")));
    let context = format!("build={}", stage.display());
    let file = ["--file", "deploy/container/Dockerfile", "--ignorefile", "deploy/container/Dockerfile.dockerignore"];
    let bud = ["bud", "--quiet", "--isolation", "chroot", "--pull-never", "--build-context", &context];
    buildah.run(&[&bud[..], &file, &["--tag", "clearway:test", "."]].concat());
    let config = buildah.run(&["inspect", "--type", "image", "--format", "{{.OCIv1.Config}}", "clearway:test"]);
    for part in ["10001:10001", "[/usr/bin/clearway]", "[serve]", "SIGTERM", "/data"] {
        assert!(config.contains(part), "{part} in {config}");
    }
    let container = buildah.run(&["from", "--pull-never", "clearway:test"]);
    buildah.run(&["mount", &container]).into()
}

fn get(at: &str, path: &str) -> String {
    let mut stream = TcpStream::connect(at).expect("the page listens");
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {at}\r\nConnection: close\r\n\r\n").expect("sent");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("an answer");
    answer
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn the_image_serves_from_a_read_only_root_without_rights_and_ends_at_sigterm() {
    let _packages = PACKAGES.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let root = built(&Buildah(folder.path().to_path_buf()));
    let config = folder.path().join("config");
    for folder in [&config, &root.join("etc/clearway")] {
        fs::create_dir_all(folder).expect("a folder of ours");
    }
    fs::copy(workspace().join("deploy/clearway.toml"), config.join("clearway.toml")).expect("copied");
    let start = |arguments: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "sh", "-c", START, "sh"]).arg(&root).arg(&config);
        command.args(["env", "CLEARWAY_CONFIG=/etc/clearway/clearway.toml"]);
        command.env("CLEARWAY__PAGE__LISTEN", "127.0.0.1:0").args(arguments);
        command
    };
    let written = start(&["sh", "-c", "touch /usr/x || touch /etc/clearway/x || touch /tmp/x"]).output().expect("sh");
    assert!(!written.status.success(), "nothing but /data can be written: {}", said(&written));

    let any = [
        "grpc.listen=127.0.0.1:0",
        "zenoh.listen=[\"tcp/127.0.0.1:0\"]",
        "vehicle.udp.data=127.0.0.1:0",
        "vehicle.udp.telemetry=127.0.0.1:0",
        "recorder.file=/data/drive.mcap",
    ];
    let set = any.iter().flat_map(|set| ["--set", set]).collect::<Vec<_>>();
    let mut server = start(&[&["/usr/bin/clearway", "serve"][..], &set].concat());
    let mut server = server.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().expect("it starts");
    let mut lines = BufReader::new(server.stderr.take().expect("piped")).lines();
    let mut log = String::new();
    let mut page = None;
    while page.is_none() {
        let line = lines.next().unwrap_or_else(|| panic!("the server ended:\n{log}")).expect("UTF-8");
        page = line.split_once("page http://").map(|(_, at)| at.trim_end_matches('/').to_owned());
        log += &format!("{line}\n");
    }
    let rest = std::thread::spawn(move || lines.map_while(Result::ok).collect::<Vec<_>>().join("\n"));
    let answer = get(&page.expect("found"), "/healthz");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("ok\n"), "{answer}");
    let status = fs::read_to_string(Path::new("/proc").join(server.id().to_string()).join("status")).expect("it runs");
    for line in
        ["Uid:\t10001\t10001\t10001\t10001", "CapEff:\t0000000000000000", "CapBnd:\t0000000000000000", "NoNewPrivs:\t1"]
    {
        assert!(status.contains(line), "{line}:\n{status}");
    }
    succeeds(Command::new("kill").args(["-TERM", &server.id().to_string()]));
    let ended = server.wait().expect("it ended");
    assert!(ended.success(), "{ended}:\n{log}{}", rest.join().expect("the log"));
}
