//! Starts with a router missing, and two joined routers as `deploy/kubernetes` has them.

use std::net::TcpListener;
use std::time::Instant;

use clearway_client::{MapStream, ZenohClient};
use clearway_daemon::config::ZenohMode;
use clearway_daemon::run::Running;

use crate::fixture::certificates::{self, certificates};
use crate::fixture::routers::router;
use crate::fixture::{Driving, config, start, within};

const LAYER: &str = "drivability";

/// A port at which nothing listens now.
fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// Waits for a map of this server on the stream.
async fn reads(what: &str, maps: &mut MapStream, server: &Running) {
    let boot_id = server.vehicles.0[0].status.boot_id;
    let read = async { while maps.next().await.expect("it does not end").map.header().boot_id != boot_id {} };
    within(&format!("maps, {what}"), read).await;
}

/// Each list of routers, with each of its members missing at the start and there afterwards.
#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_server_and_a_planner_start_with_each_of_their_routers_missing_and_use_it_once_it_is_there() {
    for mode in [ZenohMode::Client, ZenohMode::Peer, ZenohMode::Router] {
        for missing in [0, 1] {
            let what = format!("{mode:?}, router {missing} missing");
            let late = free_port();
            let (there, at) = router(0, &[]).await;
            let mut endpoints = [format!("tcp/127.0.0.1:{late}"), at.clone()];
            endpoints.swap(0, missing);
            let mut config = config();
            // A client beside its router has the router's endpoint as its default, and does not listen there.
            let listen = if mode == ZenohMode::Client { vec![at.clone()] } else { Vec::new() };
            (config.zenoh.enabled, config.zenoh.mode, config.zenoh.listen) = (true, mode, listen);
            config.zenoh.connect = endpoints.to_vec();
            let server = within(&format!("a start, {what}"), start(config)).await;
            let car = Driving::to(&server);
            // At all routers at once a planner is a peer, and a router passes nothing from one peer to another.
            let separators = if mode == ZenohMode::Client { &[",", "+"][..] } else { &[","] };
            for separator in separators {
                let what = format!("{what}, a planner with {separator}");
                let began = Instant::now();
                let planner = within(&what, ZenohClient::connect(&endpoints.join(separator))).await.expect(&what);
                let mut maps = planner.subscribe("car", LAYER).await.unwrap();
                reads(&what, &mut maps, &server).await;
                println!("{what}: first map after {:.1} s", began.elapsed().as_secs_f64());
            }
            // A client uses one router; the others use each.
            if mode != ZenohMode::Client {
                let (came, at) = router(late, &[]).await;
                let planner = ZenohClient::connect(&at).await.unwrap();
                let mut maps = planner.subscribe("car", LAYER).await.unwrap();
                reads(&format!("{what}, which came"), &mut maps, &server).await;
                came.close().await.unwrap();
            }
            car.halt();
            within("shutdown", server.shutdown()).await.unwrap();
            there.close().await.unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_reader_of_two_joined_routers_with_roles_outlives_the_end_of_either() {
    let folder = tempfile::tempdir().unwrap();
    let read = |file: &str| std::fs::read_to_string(certificates("ours").join(file)).unwrap();
    let identity = Some((read("reader.pem"), read("reader.key")));
    let tls = clearway_client::Tls { ca: read("ca.pem"), identity, server_name: String::new() };
    for ends in ["a", "b"] {
        let (a, at_a) = certificates::joined_router(&[]).await;
        let (b, at_b) = certificates::joined_router(&[&at_a]).await;
        let mut config = certificates::behind(&at_a, folder.path(), config());
        config.zenoh.connect.push(at_b.clone());
        let server = start(config).await;
        let car = Driving::to(&server);
        let mut readers = Vec::new();
        for endpoints in [at_b.clone(), format!("{at_a},{at_b}"), format!("{at_a}+{at_b}")] {
            let planner = ZenohClient::connect_tls(&endpoints, &tls).await.unwrap();
            let mut maps = planner.subscribe("car", LAYER).await.unwrap();
            reads(&endpoints, &mut maps, &server).await;
            readers.push((endpoints, maps, planner));
        }
        let (ended, went_on) = if ends == "a" { (a, b) } else { (b, a) };
        let began = Instant::now();
        within("a router ends", ended.close().into_future()).await.unwrap();
        let outlives = |endpoints: &String| endpoints.contains(&at_a) || ends == "a";
        for (endpoints, maps, _) in readers.iter_mut().filter(|(endpoints, ..)| outlives(endpoints)) {
            let newest = maps.newest().expect("a map was read").sequence();
            while within("a map", maps.next()).await.unwrap().map.sequence() <= newest + 1 {}
            println!("{ends} ended: {endpoints} has maps {:.2} s later", began.elapsed().as_secs_f64());
        }
        car.halt();
        within("shutdown", server.shutdown()).await.unwrap();
        went_on.close().await.unwrap();
    }
}
