//! Certificates and roles: which clients are accepted, how the others are refused, and what a recording has of them.

use std::fs::Permissions;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Stdio};

use clearway_client::{Client, ClientError, Observation, PublicKey, Subscription, Tls, ZenohClient, now_ns};
use clearway_daemon::config::Only;
use clearway_daemon::run::{Running, Server, Setup};
use clearway_replay::{ReplayOptions, ReplayRun, ServedReplay};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use zenoh::qos::CongestionControl;

use crate::fixture::certificates::{behind, certificates, router, secured, start, zenoh_file};
use crate::fixture::{self, before_another_look, config, feed, grpc, readings, until, within};

fn tls(ca: &str, identity: Option<(&str, &str)>) -> Tls {
    let read = |folder: &Path, file: String| std::fs::read_to_string(folder.join(file)).expect("a certificate");
    let identity = identity.map(|(of, name)| {
        let folder = certificates(of);
        (read(&folder, format!("{name}.pem")), read(&folder, format!("{name}.key")))
    });
    Tls { ca: read(&certificates(ca), "ca.pem".into()), identity, server_name: "localhost".into() }
}

/// Connects and requests the vehicles; a refused handshake may show in either step.
async fn vehicles(running: &Running, tls: &Tls) -> Result<usize, ClientError> {
    let address = running.grpc.expect("gRPC is served").to_string();
    within("an answer", async { Ok(Client::connect_tls(&address, tls).await?.vehicles().await?.len()) }).await
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_server_without_client_ca_is_readable_over_tls_only() {
    let running = start(secured(false)).await;
    assert_eq!(vehicles(&running, &tls("ours", None)).await.unwrap(), 1);
    let believed = vehicles(&running, &tls("theirs", None)).await;
    assert!(matches!(believed, Err(ClientError::Unreachable { .. })), "{believed:?}");
    let address = running.grpc.unwrap().to_string();
    let plain = within("an answer", async { Client::connect(&address).await?.vehicles().await }).await;
    assert!(matches!(plain, Err(ClientError::Unreachable { .. })), "{plain:?}");
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_certificate_allows_the_calls_of_its_roles_only() {
    let running = start(secured(true)).await;
    feed(&running, readings(2)).await;
    let address = running.grpc.unwrap().to_string();
    for (name, may_watch) in [("reader", true), ("operator", true), ("ingester", false), ("server", false)] {
        let client = Client::connect_tls(&address, &tls("ours", Some(("ours", name)))).await.expect("a handshake");
        let watched = within("an answer", async {
            let mut maps = client.subscribe(Subscription::default()).await?;
            maps.next().await.map(|update| update.map.sequence())
        })
        .await;
        match watched {
            Ok(_) => assert!(may_watch, "{name} may not watch"),
            Err(ClientError::Refused { reason, code, .. }) => {
                assert!(!may_watch && code == "PermissionDenied", "{name}: {reason}");
                assert!(reason.contains(name) && reason.contains("allowed roles are [reader, operator]"), "{reason}");
            }
            Err(other) => panic!("{name}: {other}"),
        }
        assert_eq!(client.vehicles().await.is_ok(), name != "server", "{name}");
    }
    for identity in [None, Some(("theirs", "reader"))] {
        let answer = vehicles(&running, &tls("ours", identity)).await;
        assert!(answer.is_err(), "{identity:?} is accepted");
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_recording_has_the_path_of_the_private_key_but_not_the_key() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("secured.mcap");
    let mut config = secured(true);
    config.recorder.file.clone_from(&record);
    let running = start(config).await;
    feed(&running, readings(1)).await;
    within("shutdown", running.shutdown()).await.unwrap();
    let recording = clearway_journal::reader::RecordingReader::open(&record).unwrap();
    let text = recording.header().config.clone().unwrap();
    assert!(text.contains("server.key") && !text.contains("PRIVATE"), "{text}");
    let key = std::fs::read_to_string(certificates("ours").join("server.key")).unwrap();
    let secret = key.lines().nth(1).expect("base64").as_bytes();
    let bytes = std::fs::read(&record).unwrap();
    assert!(!bytes.windows(secret.len()).any(|window| window == secret));
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn replay_with_serve_requires_the_certificates_of_its_configuration() {
    let folder = tempfile::tempdir().unwrap();
    let (file, scan) = (folder.path().join("clearway.toml"), folder.path().join("0.bin"));
    std::fs::write(&file, secured(true).to_toml()).unwrap();
    std::fs::write(&scan, [0; 16]).unwrap();
    let served = Some(ServedReplay::default());
    let options = ReplayOptions { files: vec![scan], config: Some(file), served, ..ReplayOptions::default() };
    let replay = ReplayRun::start(options).await.unwrap();
    let address = replay.running.grpc.expect("gRPC is served").to_string();
    let requests = async {
        let plain = async { Client::connect(&address).await?.vehicles().await }.await;
        assert!(plain.is_err(), "{plain:?}");
        for (name, may_ask) in [("reader", true), ("server", false)] {
            let client = Client::connect_tls(&address, &tls("ours", Some(("ours", name)))).await.expect("a handshake");
            assert_eq!(client.vehicles().await.is_ok(), may_ask, "{name}");
        }
    };
    within("a replay", replay.play(requests)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_server_with_unread_certificates_does_not_serve_in_plain_text() {
    let setup = Setup { config: secured(false), ..Setup::default() };
    let error = Server::start(setup).await.err().expect("no server").to_string();
    assert!(error.starts_with("grpc.tls: "), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn silent_resetting_and_oversized_peers_do_not_disturb_the_others() {
    let running = start(config()).await;
    feed(&running, readings(2)).await;
    let address = running.grpc.unwrap();
    // These connections never send a byte: they wait for a free connection, or are closed.
    let mut silent = Vec::new();
    for _ in 0..200 {
        silent.push(TcpStream::connect(address).await.expect("a place in the kernel's queue"));
    }
    let mut client = grpc(&running).await;
    for _ in 0..100 {
        // A stream that is dropped at once.
        let begun = client.watch(tokio_stream::once(fixture::selection("car", &[], 1))).await;
        drop(begun.expect("a stream"));
    }
    let long = clearway_proto::v1::GetMapRequest { vehicle: "x".repeat(1 << 20), layers: Vec::new() };
    let refused = client.get_map(long).await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::OutOfRange, "{refused:?}");
    let mut garbage = TcpStream::connect(address).await.unwrap();
    garbage.write_all(&[0xff; 4096]).await.unwrap();
    let mut rest = Vec::new();
    let _closed = within("the server hangs up", garbage.read_to_end(&mut rest)).await;

    let request = clearway_proto::v1::GetMapRequest { vehicle: "car".into(), layers: Vec::new() };
    let map = within("a map", client.get_map(request)).await.expect("the newest map").into_inner();
    assert!(!map.map.is_empty());
    assert_eq!(running.vehicles.0[0].status.snapshot().maps, 2);
    within("shutdown", running.shutdown()).await.unwrap();
}

/// A session of a client that connects to the router with this certificate.
async fn zenoh_client(router: &str, ca: &str, name: &str) -> zenoh::Result<zenoh::Session> {
    let folder = certificates(ca);
    let text = zenoh_file("server.json5", &folder);
    let text = ["connect_certificate", "connect_private_key"].iter().fold(text, |text, key| {
        let ending = if key.ends_with("key") { "key" } else { "pem" };
        let (from, to) = (format!("{key}: \"{}/server.{ending}\"", folder.display()), folder.join(name));
        text.replace(&from, &format!("{key}: \"{}.{ending}\"", to.display()))
    });
    let mut config = zenoh::Config::from_json5(&text)?;
    let ours = certificates("ours").join("ca.pem");
    let settings = [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[{router:?}]")),
        ("connect/timeout_ms", "5000".to_owned()),
        ("listen/endpoints", "[]".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        // Every client trusts the router's CA.
        ("transport/link/tls/root_ca_certificate", format!("{:?}", ours.display().to_string())),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value)?;
    }
    within("zenoh", zenoh::open(config).into_future()).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn the_router_of_deploy_allows_each_certificate_only_its_keys() {
    let folder = tempfile::tempdir().unwrap();
    let ours = certificates("ours");
    let (router, at) = router().await;
    let running = fixture::start(behind(&at, folder.path(), config())).await;

    let reader = zenoh_client(&at, "ours", "reader").await.expect("a session");
    let unlisted = zenoh_client(&at, "ours", "unlisted").await.expect("a session");
    let ingester = zenoh_client(&at, "ours", "ingester").await.expect("a session");
    assert!(zenoh_client(&at, "theirs", "reader").await.is_err(), "a certificate of another CA is accepted");

    let key = "clearway/car/map/drivability";
    let maps = reader.declare_subscriber(key).await.unwrap();
    let file = folder.path().join("client.json5");
    std::fs::write(&file, zenoh_file("client.json5", &ours)).unwrap();
    let planner = within("zenoh", ZenohClient::connect_with(&at, &file)).await.expect("a planner's session");
    let mut planned = planner.subscribe("car", "drivability").await.unwrap();
    let nothing = unlisted.declare_subscriber(key).await.unwrap();
    // The server's certificate may subscribe to everything, so this session sees what the others publish.
    let observer = zenoh_client(&at, "ours", "server").await.expect("a session");
    let put = observer.declare_subscriber("clearway/car/**").await.unwrap();
    let mut drive = readings(6);
    let rest = drive.split_off(drive.len() / 2);
    feed(&running, drive).await;
    within("the reader's first map", async {
        // An answer shows that the server's declarations and the reader's subscription have arrived at the router.
        while reader.get(key).await.unwrap().recv_async().await.is_err() {}
    })
    .await;
    feed(&running, rest).await;
    within("the next map", maps.recv_async().into_future()).await.expect("a map");
    within("the planner's map", planned.next()).await.expect("a map");
    assert_eq!(planner.vehicles().await.unwrap(), ["car"]);
    // Without `Block` a router drops what does not fit beside the maps that it sends to the observer just now.
    for (key, bytes) in [(key, "a false map"), ("clearway/car/ingest/pose", "something to refuse")] {
        ingester.put(key, bytes).congestion_control(CongestionControl::Block).await.unwrap();
    }
    within("what the ingester may put", async {
        loop {
            let sample = put.recv_async().await.unwrap();
            assert_ne!(*sample.payload().to_bytes(), *b"a false map", "an ingester may not put maps");
            if sample.key_expr().as_str() == "clearway/car/ingest/pose" {
                break;
            }
        }
    })
    .await;
    assert!(matches!(nothing.try_recv(), Ok(None)), "an unlisted certificate receives maps");

    for session in [reader, unlisted, ingester, observer] {
        session.close().await.unwrap();
    }
    within("shutdown", running.shutdown()).await.unwrap();
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn an_observation_over_zenoh_needs_the_role_and_the_vehicle_also_without_access_control_in_the_session() {
    let (folder, ours) = (tempfile::tempdir().unwrap(), certificates("ours"));
    let mut config = secured(true);
    let file = folder.path().join("server.json5");
    let text = zenoh_file("server.json5", &ours);
    std::fs::write(
        &file,
        text.replace("enabled: true,\n    default_permission", "enabled: false,\n    default_permission"),
    )
    .unwrap();
    (config.zenoh.enabled, config.zenoh.file) = (true, file);
    config.zenoh.listen = vec!["tls/127.0.0.1:0".into()];
    let elsewhere = Only { vehicles: vec!["van".into()], layers: Vec::new() };
    config.grpc.access.only = [("operator".to_owned(), elsewhere)].into();
    let running = start(config).await;
    let at = format!("tls/localhost:{}", running.zenoh[0].rsplit_once(':').unwrap().1);
    for (name, may_send) in [("reader", false), ("unlisted", false), ("ingester", true), ("operator", false)] {
        let file = folder.path().join(format!("{name}.json5"));
        let text = zenoh_file("client.json5", &ours);
        std::fs::write(&file, text.replace("/reader.", &format!("/{name}."))).unwrap();
        let client = within("zenoh", ZenohClient::connect_with(&at, &file)).await.expect("a session");
        let mut ingester = within("an ingester", client.ingest("car")).await.unwrap();
        let pose = Observation::pose(now_ns(), [0.0; 3], [0.0, 0.0, 0.0, 1.0], 1.0);
        within("a pose", ingester.send(pose)).await.unwrap();
        let refused = within("its outcome", ingester.settled()).await.unwrap();
        let reasons: Vec<_> = refused.iter().map(|refusal| refusal.reason.as_str()).collect();
        assert_eq!(reasons, if may_send { &[][..] } else { &["role"][..] }, "{name}: {refused:?}");
    }
    let ledger = &running.vehicles.0[0].status;
    until("the pose", || ledger.snapshot().ledger.poses == 1).await;
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn readers_with_the_public_key_believe_the_server_that_signs() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).display().to_string();
    for name in ["maps", "others"] {
        let (key, public) = (file(&format!("{name}.key")), file(&format!("{name}.pub")));
        for arguments in [
            ["genpkey", "-algorithm", "ed25519", "-out", &key].as_slice(),
            ["pkey", "-in", &key, "-pubout", "-out", &public].as_slice(),
        ] {
            assert!(std::process::Command::new("openssl").args(arguments).status().unwrap().success());
        }
    }
    let mut config = config();
    (config.zenoh.enabled, config.zenoh.signing_key) = (true, file("maps.key").into());
    std::fs::set_permissions(file("maps.key"), Permissions::from_mode(0o644)).unwrap();
    let error = Server::start(Setup { config: config.clone(), ..Setup::default() }).await.err().unwrap().to_string();
    assert!(error.contains("zenoh.signing_key") && error.contains("mode 644"), "{error}");
    std::fs::set_permissions(file("maps.key"), Permissions::from_mode(0o600)).unwrap();
    let running = fixture::start(config).await;
    let public = |name: &str| PublicKey::from_pem(&std::fs::read_to_string(file(name)).unwrap()).unwrap();
    let client = within("zenoh", ZenohClient::connect(&running.zenoh[0])).await.unwrap();
    let (ours, others) = (client.clone().signed_by(public("maps.pub")), client.signed_by(public("others.pub")));
    let mut believed = ours.subscribe("car", "drivability").await.unwrap();
    let doubted = others.subscribe("car", "drivability").await.unwrap();
    let car = fixture::Driving::to(&running);
    within("a signed map", believed.next()).await.unwrap();
    until("maps that are passed over", || doubted.passed_over().unsigned > 1).await;
    assert!(doubted.newest().is_none());
    assert_eq!(believed.passed_over().hostile(), 0);
    let queried = within("an answer", ours.newest("car", "drivability")).await.unwrap();
    assert!(queried.is_some(), "answers to queries are signed too");
    assert!(within("an answer", others.newest("car", "drivability")).await.unwrap().is_none());
    car.halt();
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn what_a_peer_publishes_on_a_wildcard_over_the_servers_keys_reaches_no_subscriber() {
    let mut config = config();
    config.zenoh.enabled = true;
    let running = fixture::start(config).await;
    let session = async || {
        let mut config = zenoh::Config::default();
        let endpoint = format!("[{:?}]", running.zenoh[0]);
        let settings =
            [("mode", "\"client\""), ("connect/endpoints", &endpoint), ("scouting/multicast/enabled", "false")];
        settings.iter().for_each(|(key, value)| config.insert_json5(key, value).unwrap());
        within("zenoh", zenoh::open(config).into_future()).await.unwrap()
    };
    let (attacker, observer) = (session().await, session().await);
    let seen = observer.declare_subscriber("clearway/**").await.unwrap();
    let others = "clearway/van/map/drivability";
    within("the server routes to the observer", async {
        while let Ok(None) = seen.try_recv() {
            attacker.put(others, "of another vehicle").await.unwrap();
            before_another_look().await;
        }
    })
    .await;
    // The last is no key of the server's.
    let forged = ["clearway/**", "clearway/*/map/*", "**", "clearway/car/map/drivability", "clearway/*/status"];
    for key in forged.into_iter().chain(["clearway/van/end"]) {
        attacker.put(key, "forged").congestion_control(CongestionControl::Block).await.unwrap();
    }
    let mut arrived = Vec::new();
    while arrived.last().is_none_or(|key| key != "clearway/van/end") {
        let sample = within("the last", seen.recv_async().into_future()).await.unwrap();
        if *sample.payload().to_bytes() == *b"forged" {
            arrived.push(sample.key_expr().to_string());
        }
    }
    assert_eq!(arrived, ["clearway/van/end"]);
    for session in [attacker, observer] {
        session.close().await.unwrap();
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_certificate_that_has_ended_is_named_in_the_status_while_serving_goes_on_until_a_new_one_is_read() {
    let (folder, mut config) = (certificates("ours"), secured(true));
    let whole = config.clone();
    let of_server = config.grpc.tls.as_mut().expect("it has certificates");
    (of_server.certificate, of_server.key) = (folder.join("expired.pem"), folder.join("expired.key"));
    let running = start(config).await;
    let named = || {
        let reasons = running.vehicles.0[0].status.assess().reasons;
        reasons.into_iter().find(|reason| reason.starts_with("the certificate of grpc.tls.certificate ended"))
    };
    until("the certificate is named", || named().is_some()).await;
    assert!(named().is_some_and(|reason| reason.contains("clients refuse it")), "{:?}", named());
    assert!(feed(&running, readings(3)).await > 0, "maps are made");
    let reader = tls("ours", Some(("ours", "reader")));
    assert!(vehicles(&running, &reader).await.is_err(), "a client refuses the certificate");

    let read = whole.certificates(Path::new("")).expect("the certificates are there");
    running.reload(&whole, read.as_ref()).expect("a certificate that holds");
    until("the certificate is not named", || named().is_none()).await;
    assert_eq!(vehicles(&running, &reader).await.unwrap(), 1);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[test]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
fn a_certificate_that_ends_soon_is_in_the_log_with_what_to_do() {
    let (folder, mut config) = (certificates("ours"), secured(true));
    let of_server = config.grpc.tls.as_mut().expect("it has certificates");
    (of_server.certificate, of_server.key) = (folder.join("soon.pem"), folder.join("soon.key"));
    let written = tempfile::tempdir().unwrap();
    let path = written.path().join("clearway.toml");
    std::fs::write(&path, config.to_toml()).unwrap();
    let mut server = Command::new(clearway_tests::binaries().join("clearway"));
    server.args(["serve", "--config"]).arg(&path).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut server = server.spawn().expect("clearway starts");
    // Without the line the server is ended after the time that any step of these tests needs.
    let (found, is_found) = std::sync::mpsc::channel();
    let lines = BufReader::new(server.stderr.take().expect("piped")).lines().map_while(Result::ok);
    let reading = std::thread::spawn(move || {
        lines.filter(|line| line.contains("certificate of grpc.tls.certificate")).for_each(|line| _ = found.send(line));
    });
    let line = is_found.recv_timeout(std::time::Duration::from_secs(60));
    server.kill().unwrap();
    server.wait().unwrap();
    reading.join().unwrap();
    let line = line.expect("the certificate is in the log");
    for words in ["WARN", "write a new one there, then SIGHUP"] {
        assert!(line.contains(words), "{words}: {line}");
    }
    // Two days in the second in which it was made.
    assert!(["ends in 47 h", "ends in 2 days"].iter().any(|left| line.contains(left)), "{line}");
}
