//! A simple planner: A* on the layer `speed`. It prints the next move at each map.
//! `cargo run -p clearway-client --example planner -- [ADDRESS]`; over zenoh with an endpoint such as
//! tcp/localhost:7447.

mod astar;
mod motion;

use astar::Planner;
use clearway_client::{Client, Subscription, ZenohClient, now_ns};
use motion::Move;

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
        let Move { curvature_per_m, mps, path_m } = planner.next_move(planner.ahead(12.0));
        println!("{}", planner.picture());
        println!(
            "map {}: path of {path_m:4.1} m; drive {mps:.1} m/s, curvature {curvature_per_m:+.3} 1/m",
            map.sequence()
        );
    }
}
