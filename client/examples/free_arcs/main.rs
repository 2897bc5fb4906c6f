//! Drives by the layer `freespace` alone: it asks for arcs and prints the next move at each map.
//! `cargo run -p clearway-client --example free_arcs -- [ADDRESS]`

mod arcs;
#[path = "../planner/motion.rs"]
mod motion;

use arcs::ArcPlanner;
use clearway_client::{Client, Subscription, now_ns};
use motion::Move;

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("localhost:50051".into());
    let selection = Subscription { layers: vec!["freespace".into()], ..Default::default() };
    let mut maps = Client::connect(&address).await?.subscribe(selection).await?;
    let mut planner = ArcPlanner::default();
    loop {
        let map = maps.next().await?.map;
        if map.is_stale(now_ns()) {
            println!("map {}: stale, so stop", map.sequence());
            continue;
        }
        planner.update(&map);
        let Move { curvature_per_m, mps, path_m } = planner.next_move(planner.ahead(12.0))?;
        println!(
            "map {}: free for {path_m:4.1} m; drive {mps:.1} m/s, curvature {curvature_per_m:+.3} 1/m",
            map.sequence()
        );
    }
}
