//! An example planner: A* on the layer `speed`; prints the planned move for each map.
//! `cargo run -p clearway-client --example planner -- [ADDRESS]`; over zenoh with an endpoint such as
//! tcp/localhost:7447.

mod astar;

use astar::{Move, Planner};
use clearway_client::{Client, Subscription, ZenohClient, now_ns};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("localhost:50051".into());
    let mut maps = match address.contains('/') {
        true => ZenohClient::connect(&address).await?.subscribe("car", "speed").await?,
        false => {
            let layers = vec!["speed".into()];
            Client::connect(&address).await?.subscribe(Subscription { layers, ..Default::default() }).await?
        }
    };
    let mut planner = Planner::default();
    loop {
        let map = maps.next().await?.map;
        if map.is_stale(now_ns()) {
            println!("map {}: stale, so stop", map.sequence());
            continue;
        }
        planner.update(&map)?;
        let Move { curvature_per_m, mps, way_m } = planner.next_move(planner.ahead(12.0));
        println!("{}", planner.picture());
        println!("map {}: a way of {way_m:4.1} m; drive {mps:.1} m/s, turn {curvature_per_m:+.3} 1/m", map.sequence());
    }
}
