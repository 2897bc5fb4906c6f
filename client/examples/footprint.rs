//! Prints how far the ground ahead is free for a vehicle. `cargo run -p clearway-client --example footprint --
//! [ADDRESS]`

use clearway_client::{Client, Footprint, Subscription, now_ns};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let address = std::env::args().nth(1).unwrap_or("localhost:50051".into());
    let layers = vec!["freespace".into()];
    let mut maps = Client::connect(&address).await?.subscribe(Subscription { layers, ..Default::default() }).await?;
    let car = Footprint { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, length_m: 4.5, width_m: 2.0 };
    loop {
        let map = maps.next().await?.map;
        let mut room_m = None;
        // A stale map does not describe the present scene.
        if !map.is_stale(now_ns()) {
            for x_m in (6..40).map(f64::from) {
                if !map.is_free("freespace", &Footprint { x_m, ..car })? {
                    break;
                }
                room_m = Some(x_m + car.length_m / 2.0);
            }
        }
        match room_m {
            Some(room_m) => println!("map {}: free up to {room_m:.1} m straight ahead", map.sequence()),
            None => println!("map {}: no room ahead", map.sequence()),
        }
    }
}
