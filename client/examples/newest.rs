//! Prints a line for each new map: `cargo run -p clearway-client --example newest -- [ADDRESS]`

use clearway_client::{Client, Subscription, now_ns};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("localhost:50051".into());
    let layers = vec!["freespace".into()];
    let mut maps = Client::connect(&address).await?.subscribe(Subscription { layers, ..Default::default() }).await?;
    loop {
        let update = maps.next().await?;
        let (map, now) = (update.map, now_ns());
        let (_, ahead) = map.layer("freespace")?.class_at(10.0, 0.0);
        let stale = if map.is_stale(now) { "STALE, " } else { "" };
        let share = 100.0 * map.metric("drivable_share").unwrap_or(0.0);
        let (sequence, age_ms, skipped) = (map.sequence(), map.age_ms(now), update.skipped);
        println!(
            "map {sequence}: {stale}{age_ms:.0} ms old, {skipped} skipped; 10 m ahead {ahead}, {share:.0} % drivable"
        );
    }
}
