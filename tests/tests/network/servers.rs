//! Several servers in one zenoh network: each lists the vehicles of all, and leads planners to them; and servers whose
//! router is not there.

use clearway_client::{Client, ClientError, Subscription, ZenohClient};
use clearway_daemon::config::ZenohMode;
use clearway_daemon::run::Running;

use crate::fixture::routers::router;
use crate::fixture::{before_another_look, config, feed, readings, start, until, within};

/// A server with one vehicle of this name, behind a router, with one map.
async fn server(vehicle: &str, router: &str) -> Running {
    server_at(vehicle, router, "127.0.0.1").await
}

/// As [`server`], which announces that it is at this host; empty: as by default.
async fn server_at(vehicle: &str, router: &str, host: &str) -> Running {
    let mut config = config();
    config.vehicles[0].name = vehicle.into();
    config.grpc.advertise = host.into();
    config.zenoh.enabled = true;
    (config.zenoh.mode, config.zenoh.listen) = (ZenohMode::Client, Vec::new());
    config.zenoh.connect = vec![router.into()];
    let running = start(config).await;
    feed(&running, readings(3)).await;
    running
}

async fn client(running: &Running) -> Client {
    Client::connect(&running.grpc.unwrap().to_string()).await.unwrap()
}

/// What a client command of `clearway` prints about a server.
async fn run(running: &Running, command: &[&str]) -> String {
    let address = running.grpc.unwrap().to_string();
    let arguments: Vec<_> = command.iter().copied().chain(["--server", &address]).map(str::to_owned).collect();
    let ended = tokio::task::spawn_blocking(move || {
        let arguments: Vec<_> = arguments.iter().map(String::as_str).collect();
        clearway_tests::run(&clearway_tests::workspace(), "clearway", &arguments)
    });
    // Not `within` the time of a step, because it may build the command.
    let output = ended.await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Names of the vehicles that a server lists.
async fn listed(client: &Client) -> Vec<String> {
    let mut names: Vec<_> = client.vehicles().await.unwrap().into_iter().map(|vehicle| vehicle.name).collect();
    names.sort();
    names
}

/// Waits until a server lists these vehicles.
async fn lists(client: &Client, expected: &[&str]) {
    within(&format!("a list of {expected:?}"), async {
        while listed(client).await != expected {
            before_another_look().await;
        }
    })
    .await;
}

fn boot_id(running: &Running) -> u64 {
    running.vehicles.0[0].status.boot_id
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn every_server_lists_the_vehicles_of_all_and_leads_a_planner_to_them() {
    let (first, near) = router(0, &[]).await;
    let (second, far) = router(0, &[&near]).await;
    let servers = [server("car", &near).await, server("van", &far).await, server("bus", &far).await];
    for running in &servers {
        lists(&client(running).await, &["bus", "car", "van"]).await;
    }

    let anywhere = client(&servers[0]).await;
    for running in &servers {
        let vehicle = &*running.vehicles.0[0].status.name;
        let newest = within("a map", anywhere.newest(vehicle, &[])).await.unwrap();
        assert_eq!(newest.header().boot_id, boot_id(running), "{vehicle}");
        let subscription = Subscription { vehicle: vehicle.into(), ..Subscription::default() };
        let mut maps = within("a stream", anywhere.subscribe(subscription)).await.unwrap();
        let update = within("a map", maps.next()).await.unwrap();
        assert_eq!(update.map.header().boot_id, boot_id(running), "{vehicle}");
    }
    for command in [&["top", "--count", "1"][..], &["vehicles"]] {
        let shown = run(&servers[0], command).await;
        let line = |name: &str| shown.lines().find(|line| line.starts_with(name)).map(str::to_owned);
        for running in &servers[1..] {
            let of = &running.vehicles.0[0].status.name;
            let line = line(of).unwrap_or_else(|| panic!("{command:?} without {of}: {shown}"));
            assert!(line.contains(&format!("({})", running.grpc.unwrap())), "its server is not named: {shown}");
        }
        assert!(line("car").is_some(), "{shown}");
    }
    let unknown = anywhere.newest("tram", &[]).await.unwrap_err();
    assert!(matches!(&unknown, ClientError::Refused { reason, .. } if reason.contains("\"tram\"")), "{unknown}");

    let [car, van, bus] = servers;
    within("shutdown", van.shutdown()).await.unwrap();
    lists(&anywhere, &["bus", "car"]).await;
    let gone = anywhere.newest("van", &[]).await.unwrap_err();
    assert!(matches!(&gone, ClientError::Refused { .. }), "{gone}");
    let moved = server("van", &near).await;
    lists(&anywhere, &["bus", "car", "van"]).await;
    assert_eq!(anywhere.newest("van", &[]).await.unwrap().header().boot_id, boot_id(&moved));
    for running in [car, bus, moved] {
        within("shutdown", running.shutdown()).await.unwrap();
    }
    second.close().await.unwrap();
    first.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn two_servers_that_claim_one_vehicle_are_both_listed_and_a_planner_keeps_the_one_it_has() {
    let (router, at) = router(0, &[]).await;
    let (car, van, other) = (server("car", &at).await, server("van", &at).await, server("van", &at).await);
    let anywhere = client(&car).await;
    lists(&anywhere, &["car", "van", "van"]).await;
    let own = client(&van).await;
    let subscription = Subscription { vehicle: "van".into(), ..Subscription::default() };
    let mut maps = within("a stream", own.subscribe(subscription)).await.unwrap();
    assert_eq!(within("a map", maps.next()).await.unwrap().map.header().boot_id, boot_id(&van));
    feed(&other, readings(3)).await;
    let made = feed(&van, readings(6).split_off(readings(3).len())).await;
    while within("a map", maps.next()).await.unwrap().map.sequence() + 1 < made {}
    until("the claim", || !van.vehicles.0[0].status.assess().claimed_by.is_empty()).await;
    for running in [car, van, other] {
        within("shutdown", running.shutdown()).await.unwrap();
    }
    router.close().await.unwrap();
}

/// Waits until the status of a server's vehicle names a router that is away with all of these words; without words,
/// until it names none.
async fn away(running: &Running, words: &[&str]) {
    let is_named = || {
        let reasons = running.vehicles.0[0].status.assess().reasons;
        let named = reasons.iter().find(|reason| reason.starts_with("no zenoh router"));
        named.map_or(words.is_empty(), |reason| !words.is_empty() && words.iter().all(|word| reason.contains(word)))
    };
    until(&format!("a router that is away with {words:?}"), is_named).await;
    let without_router = running.vehicles.0[0].status.network.without_router();
    assert_eq!(without_router.is_zero(), words.is_empty(), "{without_router:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_server_serves_without_its_router_names_it_and_has_readers_behind_it_once_it_is_there() {
    // Nothing listens there now.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let at = format!("tcp/127.0.0.1:{port}");
    let car = within("a server without its router", server("car", &at)).await;
    let newest = within("a map over gRPC", client(&car).await.newest("car", &[])).await.unwrap();
    assert_eq!(newest.header().boot_id, boot_id(&car));
    away(&car, &[&at, "refused", "its readers get no maps"]).await;

    let (first, _) = router(port, &[]).await;
    let planner = within("zenoh", ZenohClient::connect(&at)).await.unwrap();
    let mut maps = within("a stream", planner.subscribe("car", "drivability")).await.unwrap();
    assert_eq!(within("a map over zenoh", maps.next()).await.unwrap().map.header().boot_id, boot_id(&car));
    away(&car, &[]).await;
    within("the router goes", first.close().into_future()).await.unwrap();
    away(&car, &[&at, "refused"]).await;
    let (second, _) = router(port, &[]).await;
    away(&car, &[]).await;
    within("shutdown", car.shutdown()).await.unwrap();
    second.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_peer_names_the_endpoint_that_does_not_answer_and_not_the_one_that_does() {
    let (there, near) = router(0, &[]).await;
    // Nothing listens there now.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let far = format!("tcp/127.0.0.1:{port}");
    let mut config = config();
    config.zenoh.enabled = true;
    (config.zenoh.mode, config.zenoh.listen) = (ZenohMode::Peer, Vec::new());
    config.zenoh.connect = vec![near.clone(), far.clone()];
    let car = within("a peer without one of its routers", start(config)).await;
    away(&car, &[&format!("at {far} for"), "refused"]).await;
    let (late, _) = router(port, &[]).await;
    away(&car, &[]).await;
    within("the first router goes", there.close().into_future()).await.unwrap();
    away(&car, &[&format!("at {near} for"), "refused"]).await;
    within("shutdown", car.shutdown()).await.unwrap();
    late.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_router_that_accepts_connections_and_no_session_is_named_while_serving_goes_on() {
    let refuses = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = format!("tcp/{}", refuses.local_addr().unwrap());
    let closing = tokio::spawn(async move { while refuses.accept().await.is_ok() {} });
    let car = within("a server without a session", server("car", &at)).await;
    assert!(within("a map over gRPC", client(&car).await.newest("car", &[])).await.is_ok());
    away(&car, &[&at, "accepts connections but no session"]).await;
    within("shutdown", car.shutdown()).await.unwrap();
    closing.abort();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_vehicle_of_a_server_that_announces_no_address_is_refused_with_what_to_set_there() {
    let (router, at) = router(0, &[]).await;
    let (car, van) = (server("car", &at).await, server_at("van", &at, "").await);
    let anywhere = client(&car).await;
    lists(&anywhere, &["car", "van"]).await;
    let refused = anywhere.newest("van", &[]).await.unwrap_err().to_string();
    for word in ["\"van\"", "announces no address", "grpc.advertise"] {
        assert!(refused.contains(word), "{refused}");
    }
    for running in [car, van] {
        within("shutdown", running.shutdown()).await.unwrap();
    }
    router.close().await.unwrap();
}
