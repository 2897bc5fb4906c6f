//! Follows the safe points of the layer `safe_path` (UT Austin thesis, section VI). It prints the next move at each
//! map. `cargo run -p clearway-client --example follower -- [ADDRESS]`

#[path = "../planner/motion.rs"]
mod motion;
mod safe_points;

use clearway_client::{Client, Subscription, now_ns};
use motion::Move;
use safe_points::Follower;

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("localhost:50051".into());
    let selection = Subscription { layers: vec!["safe_path".into()], ..Default::default() };
    let mut maps = Client::connect(&address).await?.subscribe(selection).await?;
    let mut follower = Follower::default();
    loop {
        let map = maps.next().await?.map;
        if map.is_stale(now_ns()) {
            println!("map {}: stale, so stop", map.sequence());
            continue;
        }
        follower.update(&map)?;
        let Move { curvature_per_m, mps, path_m } = follower.next_move(follower.ahead(10.0));
        let points = map.layer("safe_path")?.points.len();
        println!(
            "map {}: {points} safe points, path of {path_m:4.1} m; drive {mps:.1} m/s, curvature {curvature_per_m:+.3} 1/m",
            map.sequence()
        );
    }
}
