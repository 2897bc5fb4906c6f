//! Every option of a subscription, as the Rust client asks for it; the Python client's own tests read the same table.

use clearway_client::{Client, ClientError, Subscription};
use clearway_proto::v1::Region;
use serde_json::Value;

use crate::fixture::{self, config, start, until, within};

fn subscription(options: &Value) -> Subscription {
    let text = |name: &str| options[name].as_str().unwrap_or_default().to_owned();
    let layers = options["layers"].as_array().into_iter().flatten();
    let region = options["region"].as_array().map(|bounds| {
        let bound = |index: usize| bounds[index].as_f64().expect("metres");
        Region { x_from_m: bound(0), x_to_m: bound(1), y_from_m: bound(2), y_to_m: bound(3) }
    });
    Subscription {
        vehicle: text("vehicle"),
        layers: layers.map(|layer| layer.as_str().expect("a name").to_owned()).collect(),
        max_in_flight: options["max_in_flight"].as_u64().unwrap_or(2) as u32,
        max_rate_hz: options["max_rate_hz"].as_f64(),
        region,
        deltas: options["deltas"].as_bool().unwrap_or_default(),
        ..Subscription::default()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn every_option_of_a_subscription_is_served_or_refused_as_the_golden_table_says() {
    let running = start(config()).await;
    let car = fixture::Driving::to(&running);
    let status = running.vehicles.0[0].status.clone();
    until("a map", || status.snapshot().maps > 0).await;
    let client = Client::connect(&running.grpc.expect("gRPC is served").to_string()).await.expect("a server");
    let table = include_str!("../../../client/golden/subscriptions.json");
    for row in serde_json::from_str::<Vec<Value>>(table).expect("a table") {
        let (options, refused) = (&row["options"], &row["refused"]);
        match within("an answer", client.subscribe(subscription(options))).await {
            Ok(mut maps) => {
                assert!(refused.is_null(), "{options} is served");
                within("a map", maps.next()).await.expect("a map");
            }
            Err(ClientError::Refused { reason, code, .. }) => {
                let expected = refused["code"].as_str().expect("a code").replace('_', "");
                assert!(code.eq_ignore_ascii_case(&expected), "{options}: {code}, not {expected}");
                assert!(reason.contains(refused["says"].as_str().expect("a text")), "{options}: {reason}");
            }
            Err(error) => panic!("{options}: {error}"),
        }
    }
    car.halt();
    within("shutdown", running.shutdown()).await.unwrap();
}
