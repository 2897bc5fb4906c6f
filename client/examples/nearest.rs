//! Prints the distance and direction of the nearest obstacle. `cargo run -p clearway-client --example nearest --
//! [ADDRESS]`

use clearway_client::{Client, Subscription, now_ns};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("localhost:50051".into());
    let layers = vec!["freespace".into()];
    let mut maps = Client::connect(&address).await?.subscribe(Subscription { layers, ..Default::default() }).await?;
    loop {
        let map = maps.next().await?.map;
        let age_ms = map.age_ms(now_ns());
        match map.nearest_obstacle("freespace", [0.0; 2], None)? {
            Some(obstacle) => {
                let bearing_deg = obstacle.bearing_rad.to_degrees();
                let side = if bearing_deg < 0.0 { "right" } else { "left" };
                let (distance_m, angle_deg) = (obstacle.distance_m, bearing_deg.abs());
                println!("{age_ms:.0} ms ago: {distance_m:.1} m away, {angle_deg:.0} degrees to the {side}");
            }
            None => println!("{age_ms:.0} ms ago: none known"),
        }
    }
}
