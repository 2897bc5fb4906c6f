//! Maps over zenoh in a fleet: through a router that stops and starts again, and beside a reader that has stopped.

use std::sync::{Arc, Mutex, mpsc};

use clearway_client::{MapStream, StreamEvent, ZenohClient};
use clearway_daemon::config::ZenohMode;
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::run::{Running, Server, Setup};
use zenoh::sample::SampleKind;

use crate::fixture::routers::router;
use crate::fixture::{Driving, before_another_look, config, feed, readings, sequence, start, within};

const LAYER: &str = "drivability";

/// Portions of less than a revolution (about 350 datagrams), so that each portion makes at most one map.
fn portions(tenths: i64) -> impl Iterator<Item = Vec<Reading>> {
    let mut readings = readings(tenths).into_iter();
    std::iter::from_fn(move || Some(readings.by_ref().take(300).collect::<Vec<_>>()).filter(|some| !some.is_empty()))
}

/// Counts of the maps that one planner has received.
#[derive(Debug, Default, PartialEq)]
struct Given {
    maps: u64,
    skipped: u64,
    lost: u64,
}

impl Given {
    /// Receives maps up to this one.
    async fn receive_up_to(&mut self, sequence: u64, maps: &mut MapStream) {
        loop {
            let update = within("a map", maps.next()).await.expect("a stream does not end with its router");
            self.maps += 1;
            self.skipped += update.skipped;
            self.lost += update.lost;
            if update.map.sequence() == sequence {
                return;
            }
        }
    }
}

async fn planner(endpoint: &str) -> (ZenohClient, MapStream) {
    let client = within("zenoh", ZenohClient::connect(endpoint)).await.expect("zenoh answers");
    let maps = within("a stream", client.subscribe("car", LAYER)).await.expect("a stream");
    (client, maps)
}

async fn newest(client: &ZenohClient) -> Option<u64> {
    let newest = within("an answer", client.newest("car", LAYER)).await.expect("an answer");
    newest.map(|map| map.sequence())
}

async fn behind(router: &str) -> Running {
    let mut config = config();
    config.zenoh.enabled = true;
    (config.zenoh.mode, config.zenoh.listen) = (ZenohMode::Client, Vec::new());
    config.zenoh.connect = vec![router.into()];
    start(config).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn streams_through_a_router_survive_a_restart_of_the_router() {
    let (first, at) = router(0, &[]).await;
    let port = at.rsplit_once(':').and_then(|(_, port)| port.parse().ok()).expect("a port");
    let running = behind(&at).await;
    let mut portions = portions(20);
    let mut next = 0;
    while next < 2 {
        next = feed(&running, portions.next().unwrap()).await;
    }

    // The newest map has left the server when a planner has it.
    let (_before, mut maps_before) = planner(&at).await;
    Given::default().receive_up_to(next - 1, &mut maps_before).await;
    drop(maps_before);
    let (early, mut early_maps) = planner(&at).await;
    let (mut early_given, mut late_given) = (Given::default(), Given::default());
    early_given.receive_up_to(next - 1, &mut early_maps).await;
    assert_eq!(early_given, Given { maps: 1, ..Given::default() }, "the current map only");
    assert_eq!(newest(&early).await, Some(next - 1));
    assert_eq!(early.vehicles().await.unwrap(), ["car"]);
    let (late, mut late_maps) = planner(&at).await;
    late_given.receive_up_to(next - 1, &mut late_maps).await;
    let begun = next;
    while next < begun + 6 {
        let maps = feed(&running, portions.next().unwrap()).await;
        for sequence in next..maps {
            early_given.receive_up_to(sequence, &mut early_maps).await;
            late_given.receive_up_to(sequence, &mut late_maps).await;
        }
        next = maps;
    }
    let each = Given { maps: 1 + next - begun, skipped: 0, lost: 0 };
    assert_eq!((&early_given, &late_given), (&each, &each));

    // The router stops: maps are made and reach no reader. The streams report their map as stale, and wait.
    within("the router goes", first.close().into_future()).await.unwrap();
    let before = next;
    while next < before + 3 {
        next = feed(&running, portions.next().unwrap()).await;
    }
    let (second, _) = router(port, &[]).await;
    early_given.receive_up_to(next - 1, &mut early_maps).await;
    late_given.receive_up_to(next - 1, &mut late_maps).await;
    for given in [&early_given, &late_given] {
        let missed = next - before - (given.maps - each.maps);
        assert_eq!(
            (given.skipped, given.lost),
            (missed, missed),
            "each of {} maps is received or lost: {given:?}",
            next - before
        );
    }
    while newest(&late).await != Some(next - 1) {}

    let watcher = within("zenoh", zenoh::open(client_of(&at)).into_future()).await.unwrap();
    let tokens = watcher.liveliness().declare_subscriber("clearway/*").history(true).await.unwrap();
    let token = within("the vehicle's token", tokens.recv_async().into_future()).await.unwrap();
    assert_eq!((token.kind(), token.key_expr().as_str()), (SampleKind::Put, "clearway/car"));
    within("shutdown", running.shutdown()).await.unwrap();
    let token = within("the token vanishes", tokens.recv_async().into_future()).await.unwrap();
    assert_eq!((token.kind(), token.key_expr().as_str()), (SampleKind::Delete, "clearway/car"));
    assert!(early.vehicles().await.unwrap().is_empty());
    // The drive is old: its last map is stale and reported as stale, although the server has stopped.
    let Ok(StreamEvent::Stale(update)) = within("stale", early_maps.next_or_stale()).await else {
        panic!("it is stale")
    };
    assert_eq!(update.map.sequence(), next - 1);
    assert!(early_maps.ended().is_none());
    watcher.close().await.unwrap();
    second.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_dead_router_before_a_live_one_costs_a_planner_no_maps() {
    let (router, at) = router(0, &[]).await;
    let running = behind(&at).await;
    let mut made = 0;
    while made == 0 {
        made = feed(&running, readings(2)).await;
    }
    // Nothing listens there now.
    let dead = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    for separator in [",", "+"] {
        let (_client, mut maps) = planner(&format!("tcp/{dead}{separator}{at}")).await;
        Given::default().receive_up_to(made - 1, &mut maps).await;
    }
    within("shutdown", running.shutdown()).await.unwrap();
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_planner_of_all_routers_has_the_maps_of_a_router_that_starts_after_it() {
    let [dead, late] = [(); 2].map(|()| std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap());
    let (_client, mut maps) = planner(&format!("tcp/{dead}+tcp/{late}")).await;
    let (router, at) = router(late.port(), &[]).await;
    let running = behind(&at).await;
    let mut made = 0;
    while made == 0 {
        made = feed(&running, readings(2)).await;
    }
    Given::default().receive_up_to(made - 1, &mut maps).await;
    within("shutdown", running.shutdown()).await.unwrap();
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_layer_without_subscribers_is_made_at_once_for_a_new_planner() {
    let mut config = config();
    config.zenoh.enabled = true;
    // There is no recording and no subscriber, so no layer is made.
    let running = Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts");
    let maps = feed(&running, readings(3)).await;
    let made = || running.vehicles.0[0].newest.borrow().clone().expect("a map");
    assert!(made().layers.is_empty());
    let (_client, mut stream) = planner(&running.zenoh[0]).await;
    let update = within("the newest revolution's map", stream.next()).await.unwrap();
    assert_eq!((update.map.sequence(), update.skipped), (maps, 0));
    assert_eq!(update.map.header().capture_end_ns, made().capture_end_ns);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_ros_2_node_behind_the_router_of_rmw_zenoh_hears_a_server_in_its_default_mode() {
    // As rmw_zenoh ships them: the router passes nothing from one peer to another, and nodes are peers.
    let settings = |mode: &str, listen: &str, connect: &[&str]| {
        let mut config = zenoh::Config::default();
        let gossip = r#"{ enabled: true, target: { router: ["router", "peer"], peer: ["router"] },
                          autoconnect: { router: [], peer: ["router", "peer"] } }"#;
        for (key, value) in [
            ("mode", format!("{mode:?}")),
            ("listen/endpoints", format!("[{listen:?}]")),
            ("connect/endpoints", format!("{connect:?}")),
            ("scouting/multicast/enabled", "false".into()),
            ("scouting/gossip", gossip.into()),
            ("routing/router/peers_failover_brokering", "false".into()),
        ] {
            config.insert_json5(key, &value).unwrap();
        }
        config
    };
    let any = "tcp/127.0.0.1:0";
    let router = within("a router", zenoh::open(settings("router", any, &[])).into_future()).await.unwrap();
    let at = router.info().locators().await.first().expect("it listens").to_string();
    let mut config = config();
    config.zenoh.enabled = true;
    (config.zenoh.listen, config.zenoh.connect) = (vec![any.into()], vec![at.clone()]);
    config.zenoh.ros2.enabled = true;
    let running = start(config).await;
    let node = within("a node", zenoh::open(settings("peer", any, &[&at])).into_future()).await.unwrap();
    let grids = node.declare_subscriber("0/clearway/car/drivability/nav_msgs::msg::dds_::OccupancyGrid_/**").await;
    let grids = grids.unwrap();
    let car = Driving::to(&running);
    within("a grid", grids.recv_async().into_future()).await.unwrap();
    car.halt();
    within("shutdown", running.shutdown()).await.unwrap();
    node.close().await.unwrap();
    router.close().await.unwrap();
}

fn client_of(endpoint: &str) -> zenoh::Config {
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "'client'").unwrap();
    config.insert_json5("connect/endpoints", &format!("[{endpoint:?}]")).unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    config
}

/// Least number of maps that the stopped reader does not read.
const MAPS: u64 = 300;
const HEALTHY: usize = 8;

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_stopped_subscriber_does_not_slow_eight_others() {
    let mut config = config();
    config.zenoh.enabled = true;
    let running = start(config).await;
    let at = running.zenoh.first().expect("zenoh listens").clone();

    // The callback does not return, so the socket is not read. The kernel's buffer for it is small.
    let mut config = client_of(&at);
    config.insert_json5("transport/link/tcp", "{ so_rcvbuf: 4096 }").unwrap();
    let session = within("zenoh", zenoh::open(config).into_future()).await.unwrap();
    let (go_on, halted) = mpsc::channel::<()>();
    let (halted, seen) = (Mutex::new(halted), Arc::new(Mutex::new(Vec::new())));
    let stopped = session.declare_subscriber("clearway/car/map/*").callback({
        let seen = seen.clone();
        move |sample| {
            // Returns when the test drops the sender.
            _ = halted.lock().unwrap().recv();
            if sample.key_expr().as_str().ends_with(LAYER) {
                seen.lock().unwrap().push(sequence(&sample.payload().to_bytes().into_owned().into()));
            }
        }
    });
    let stopped = stopped.await.unwrap();

    let mut planners = Vec::new();
    for _ in 0..HEALTHY {
        let (client, maps) = planner(&at).await;
        planners.push((client, maps, Given::default()));
    }
    let mut portions = portions(MAPS as i64 + 30);
    let (mut next, mut bytes) = (0, 0);
    while next < MAPS {
        let maps = feed(&running, portions.next().expect("a drive of so many revolutions")).await;
        let newest = running.vehicles.0[0].newest.borrow().clone();
        bytes += newest.filter(|_| maps > next).map_or(0, |map| map.select(&[]).len());
        for sequence in next..maps {
            for (_, maps, given) in &mut planners {
                given.receive_up_to(sequence, maps).await;
            }
        }
        next = maps;
    }
    let (mut given, mut skipped) = (0, 0);
    for (_, _, planner) in &planners {
        assert_eq!(planner.maps + planner.skipped, next, "{planner:?}");
        (given, skipped) = (given + planner.maps, skipped + planner.skipped);
    }
    println!("{given} maps received, {skipped} skipped; the stopped reader did not read {bytes} bytes");
    // This is far more than the queue and the sockets hold, so the link was congested.
    assert!(bytes > 4 << 20, "{bytes} bytes");
    assert!(1000 * given >= 999 * (given + skipped), "{given} maps received, {skipped} skipped");

    // The stopped reader resumes: it reads the waiting maps, then the new maps. Only this reader misses the maps
    // between.
    drop(go_on);
    let last_seen = || seen.lock().unwrap().last().copied();
    let (mut before, mut looks) = (None, 0);
    while last_seen() != Some(next - 1) {
        // A reader that still reads what waits gets no new map.
        let newest = last_seen();
        looks = if newest == before { looks + 1 } else { 0 };
        before = newest;
        if looks < 50 {
            before_another_look().await;
            continue;
        }
        looks = 0;
        let maps = feed(&running, portions.next().expect("a drive of some revolutions more")).await;
        for (_, stream, given) in planners.iter_mut().filter(|_| maps > next) {
            given.receive_up_to(maps - 1, stream).await;
        }
        next = maps;
    }
    let seen = seen.lock().unwrap().len() as u64;
    println!("the stopped reader has {seen} of {next} maps");
    assert!(seen < next, "it has {seen} of {next} maps");
    stopped.undeclare().await.unwrap();
    session.close().await.unwrap();
    within("shutdown", running.shutdown()).await.unwrap();
}
