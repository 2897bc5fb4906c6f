//! Certificates, tokens and roles on the page, the metrics and Foxglove; access by vehicle and layer; and their change
//! while the server runs.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use clearway_client::{Client, ClientError, Subscription, Tls};
use clearway_daemon::config::Only;

use super::get;
use crate::fixture::certificates::{TOKEN, certificates, secured, start, with_roles};
use crate::fixture::https::ask;
use crate::fixture::{feed, readings, within};

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn every_path_asks_for_a_certificate_or_a_token_with_a_role() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(with_roles(folder.path())).await;
    feed(&running, readings(2)).await;
    let [page, metrics, foxglove] = [running.page, running.metrics, running.foxglove].map(Option::unwrap);
    // No certificate, one of another CA, and the roles reader, ingester, operator; "server" has no role.
    let callers = [None, Some("theirs"), Some("server"), Some("reader"), Some("ingester"), Some("operator")];
    for (address, path, expected) in [
        (page, "/healthz", [200, 0, 200, 200, 200, 200]),
        (metrics, "/readyz", [200, 0, 200, 200, 200, 200]),
        (metrics, "/metrics", [401, 0, 403, 200, 200, 200]),
        (page, "/metrics", [401, 0, 403, 200, 200, 200]),
        (page, "/vehicles", [401, 0, 403, 200, 200, 200]),
        (page, "/", [401, 0, 403, 200, 403, 200]),
        (page, "/main.js", [401, 0, 403, 200, 403, 200]),
        // 400: it is no WebSocket.
        (page, "/live", [401, 0, 403, 400, 403, 400]),
        (foxglove, "/", [401, 0, 403, 400, 403, 400]),
    ] {
        for (caller, expected) in callers.into_iter().zip(expected) {
            let identity = caller.map(|name| if name == "theirs" { ("theirs", "reader") } else { ("ours", name) });
            let (status, answer) = ask(address, &get(path), identity).await;
            // 503 answers too: no map has come for a second.
            let status = if path == "/readyz" && status == 503 { 200 } else { status };
            assert_eq!(status, expected, "{caller:?} {path}: {answer}");
        }
    }
    let bearer = |token: &str| format!("{}Authorization: Bearer {token}\r\n", get("/metrics"));
    assert_eq!(ask(metrics, &bearer(TOKEN), None).await.0, 200);
    assert_eq!(ask(metrics, &bearer(&TOKEN.replace('f', "e")), None).await.0, 401);
    // A browser: the token in the address becomes a cookie, and the address loses it.
    let browser = format!("{}Accept: text/html\r\n", get(&format!("/?token={TOKEN}")));
    let (status, answer) = ask(page, &browser, None).await;
    assert!(status == 303 && answer.contains("location: ./\r\n"), "{answer}");
    // The address is relative, so that it has the folders of a proxy, and no path becomes another host.
    for (path, location) in
        [("/?vehicle=bus&", "./?vehicle=bus"), ("/a/b.html?", "./b.html"), ("//evil.example/?", "./")]
    {
        let asked = browser.replace("GET /?", &format!("GET {path}"));
        let answer = ask(page, &asked, None).await.1;
        assert!(answer.contains(&format!("location: {location}\r\n")), "{path}: {answer}");
    }
    let cookie = answer.lines().find_map(|line| line.strip_prefix("set-cookie: ")).unwrap();
    assert!(["HttpOnly", "Secure", "SameSite=Strict"].iter().all(|word| cookie.contains(word)), "{cookie}");
    let cookie = cookie.split(';').next().unwrap();
    assert_eq!(ask(page, &format!("{}Cookie: {cookie}\r\n", get("/")), None).await.0, 200);
    assert_eq!(ask(page, &format!("{}Cookie: {cookie}x\r\n", get("/")), None).await.0, 401);
    // Plain text is not answered.
    assert_eq!(super::ask(page, &get("/healthz")).await.find("200"), None);
    within("shutdown", running.shutdown()).await.unwrap();
}

fn client_tls(ca: &str, name: &str) -> Tls {
    let read = |ca: &str, file: String| std::fs::read_to_string(certificates(ca).join(file)).unwrap();
    let identity = Some((read("ours", format!("{name}.pem")), read("ours", format!("{name}.key"))));
    Tls { ca: read(ca, "ca.pem".into()), identity, server_name: "localhost".into() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_name_reaches_only_its_vehicles_and_layers() {
    let mut config = secured(true);
    let only = Only { vehicles: vec!["car".into()], layers: vec!["drivability".into()] };
    let elsewhere = Only { vehicles: vec!["van".into()], layers: Vec::new() };
    config.grpc.access.only = [("reader".to_owned(), only), ("ingester".to_owned(), elsewhere)].into();
    let running = start(config).await;
    let address = running.grpc.unwrap().to_string();
    let client = Client::connect_tls(&address, &client_tls("ours", "reader")).await.unwrap();
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    feed(&running, readings(3)).await;
    let streamed = within("a map", maps.next()).await.unwrap().map;
    let newest = client.newest("car", &[]).await.unwrap();
    for map in [streamed, newest] {
        assert_eq!(map.layers().iter().map(|layer| &*layer.name).collect::<Vec<_>>(), ["drivability"]);
    }
    let occupancy = ["occupancy".to_owned()];
    let denied = client.newest("car", &occupancy).await.unwrap_err().to_string();
    assert!(denied.contains("layer occupancy of car: not allowed by grpc.access.only"), "{denied}");
    let layers = Subscription { layers: occupancy.into(), ..Subscription::default() };
    assert!(matches!(client.subscribe(layers).await, Err(ClientError::Refused { .. })));
    let ingester = Client::connect_tls(&address, &client_tls("ours", "ingester")).await.unwrap();
    assert!(ingester.vehicles().await.unwrap().is_empty(), "only vehicles that it may reach are listed");
    let refused = ingester.ingest("car").await.err().map(|error| error.to_string()).unwrap_or_default();
    assert!(refused.contains("vehicle car: not allowed"), "{refused}");
    drop(maps);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn readiness_is_told_to_everybody_and_names_only_vehicles_that_the_caller_may_reach() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = with_roles(folder.path());
    let elsewhere = Only { vehicles: vec!["van".into()], layers: Vec::new() };
    config.grpc.access.only = [("ingester".to_owned(), elsewhere)].into();
    let running = start(config).await;
    let metrics = running.metrics.unwrap();
    for (caller, is_named) in [(None, false), (Some("ingester"), false), (Some("reader"), true)] {
        let (status, answer) = ask(metrics, &get("/readyz"), caller.map(|name| ("ours", name))).await;
        assert_eq!((status, answer.contains("vehicle car: no packets")), (503, is_named), "{caller:?}: {answer}");
        assert!(answer.contains("not ready\n"), "{answer}");
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn certificates_and_roles_change_without_losing_a_reader_that_keeps_its_role() {
    let mut config = secured(true);
    let running = start(config.clone()).await;
    let address = running.grpc.unwrap().to_string();
    let reader = Client::connect_tls(&address, &client_tls("ours", "reader")).await.unwrap();
    let mut cut = reader.subscribe(Subscription::default()).await.unwrap();
    let operator = Client::connect_tls(&address, &client_tls("ours", "operator")).await.unwrap();
    let mut maps = operator.subscribe(Subscription::default()).await.unwrap();
    let mut drive = readings(6);
    let rest = drive.split_off(drive.len() / 2);
    feed(&running, drive).await;
    within("a map", maps.next()).await.unwrap();
    within("a map", cut.next()).await.unwrap();

    // The server shows a certificate of the other CA; readers lose their role; the operator stays.
    let theirs = certificates("theirs");
    let tls = config.grpc.tls.as_mut().unwrap();
    (tls.certificate, tls.key) = (theirs.join("server.pem"), theirs.join("server.key"));
    config.grpc.access.readers.clear();
    let read = config.certificates(Path::new("")).unwrap();
    running.reload(&config, read.as_ref()).unwrap();
    let maps_made = feed(&running, rest).await;
    let ended = within("the stream of the lost role is cut", async {
        loop {
            if let Err(ended) = cut.next().await {
                return ended;
            }
        }
    });
    let ended = ended.await;
    assert!(matches!(ended, ClientError::Unreachable { .. } | ClientError::Ended { .. }), "{ended:?}");
    within("the operator's stream goes on", async {
        while maps.next().await.unwrap().map.sequence() + 1 < maps_made {}
    })
    .await;
    let before = Client::connect_tls(&address, &client_tls("ours", "operator")).await;
    assert!(before.is_err(), "a client that trusts the old CA only");
    let operator = Client::connect_tls(&address, &client_tls("theirs", "operator")).await.unwrap();
    assert_eq!(operator.vehicles().await.unwrap().len(), 1);
    let reader = Client::connect_tls(&address, &client_tls("theirs", "reader")).await.unwrap();
    assert!(reader.vehicles().await.is_err(), "it has no role any more");
    let mut without = config.clone();
    without.grpc.tls = None;
    assert!(running.reload(&without, None).unwrap_err().contains("restart"), "never plain text while it runs");
    drop(maps);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[test]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
fn a_key_or_token_that_every_user_may_read_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = with_roles(folder.path());
    assert!(config.certificates(Path::new("")).is_ok());
    let token = config.grpc.access.tokens["prometheus"].clone();
    let key = folder.path().join("server.key");
    std::fs::copy(&config.grpc.tls.as_ref().unwrap().key, &key).unwrap();
    config.grpc.tls.as_mut().unwrap().key.clone_from(&key);
    for (file, name) in [(&key, "grpc.tls.key"), (&token, "grpc.access.tokens.prometheus")] {
        for (mode, is_allowed) in [(0o644, false), (0o604, false), (0o600, true), (0o640, true)] {
            std::fs::set_permissions(file, std::fs::Permissions::from_mode(mode)).unwrap();
            match config.certificates(Path::new("")) {
                Ok(_) => assert!(is_allowed, "{mode:o}"),
                Err(error) => {
                    let text = error.to_string();
                    assert!(!is_allowed && text.contains(name) && text.contains("mode 6"), "{text}");
                }
            }
        }
    }
    std::fs::write(&token, "short").unwrap();
    assert!(config.certificates(Path::new("")).err().unwrap().to_string().contains("at least 32"));
}
