//! Plans of planners: taken, recorded beside the maps, shown with the maps, and refused with their values.

use std::time::Instant;

use clearway_client::test::Replay;
use clearway_client::{Client, ClientError, MapView, PlanError, Subscription, ZenohClient, now_ns};
use clearway_daemon::record::verify;
use clearway_daemon::run::Running;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_mapping::event::Body;
use clearway_proto::v1;
use clearway_proto::v1::map_service_client::MapServiceClient;
use clearway_proto::v1::plan_service_client::PlanServiceClient;
use futures::{StreamExt, stream};
use prost::Message;
use tonic::Code;
use tonic::transport::Channel;
use zenoh::qos::CongestionControl;

use super::{client, start};
use crate::fixture::{config, feed, readings, recorded, until, within};

async fn channel(running: &Running) -> Channel {
    Channel::from_shared(format!("http://{}", running.grpc.unwrap())).unwrap().connect().await.unwrap()
}

async fn newest(client: &Client) -> MapView {
    within("a map", client.newest("car", &["drivability".into()])).await.unwrap()
}

/// Straight ahead, with a footprint, a goal and a text.
fn ahead(map: &MapView) -> v1::Plan {
    v1::Plan {
        footprint_m: vec![2.0, 1.0, -2.0, 1.0, -2.0, -1.0, 2.0, -1.0],
        goal: Some(v1::PlanGoal { x: 30.0, y: 0.0 }),
        text: "blocked by a wall".into(),
        ..map.plan("straight", &[[0.0, 0.0], [5.0, 0.0], [12.0, 0.5]])
    }
}

/// The number of refused plans in the status.
fn refused(running: &Running) -> u64 {
    running.vehicles.0[0].status.to_proto().observations_refused.get("plan").copied().unwrap_or_default()
}

async fn watch_with_plans(channel: Channel) -> tonic::Streaming<v1::MapUpdate> {
    let selection = v1::Selection { plans: true, ..Default::default() };
    let request = v1::WatchRequest { selection: Some(selection), ..Default::default() };
    let requests = stream::iter([request]).chain(stream::pending());
    within("a stream", MapServiceClient::new(channel).watch(requests)).await.unwrap().into_inner()
}

/// The next map, with the plan that came with it.
async fn next(updates: &mut tonic::Streaming<v1::MapUpdate>) -> (MapView, Option<Box<v1::Plan>>) {
    let update = within("a map", updates.message()).await.unwrap().unwrap();
    (MapView::decode(update.map).unwrap(), update.plan)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_plan_comes_with_the_maps_after_it_and_changes_no_byte_of_them() {
    let folder = tempfile::tempdir().unwrap();
    let [with_plans, without] = ["with.mcap", "without.mcap"].map(|name| folder.path().join(name));
    let (first, second) = {
        let mut first = readings(8);
        let second = first.split_off(first.len() / 2);
        (first, second)
    };
    let running = start(config(), &without).await;
    feed(&running, first.iter().chain(&second).cloned().collect()).await;
    within("shutdown", running.shutdown()).await.unwrap();

    let running = start(config(), &with_plans).await;
    let client = client(&running).await;
    feed(&running, first).await;
    let mut updates = watch_with_plans(channel(&running).await).await;
    let (map, plan) = next(&mut updates).await;
    assert_eq!(plan, None, "none was sent");
    let sent = ahead(&map);
    within("an answer", client.send_plan(&sent)).await.unwrap();
    // A reader that asks for no plans gets none.
    let mut plain = client.subscribe(Subscription::default()).await.unwrap();
    feed(&running, second).await;
    within("a map", plain.next()).await.unwrap();
    let (later, plan) = next(&mut updates).await;
    let plan = plan.expect("a plan");
    assert!(later.sequence() > map.sequence() && plan.map_sequence == Some(map.sequence()));
    assert_eq!((&plan.x, &plan.text, plan.goal), (&sent.x, &sent.text, sent.goal));
    assert_eq!(plan.heading_rad.len(), 3, "each point has a heading");
    within("shutdown", running.shutdown()).await.unwrap();

    assert!(recorded(&with_plans) == recorded(&without), "the same bytes");
    let report = verify(&with_plans).unwrap();
    assert!(report.is_good(), "{:?}", report.differences);
    let events = RecordingReader::open(&with_plans).unwrap().map(Result::unwrap);
    let plans: Vec<_> = events
        .filter_map(|message| match message {
            RecordedMessage::Event { event, .. } => match event.body {
                Body::Plan(bytes) => Some(v1::Plan::decode(bytes).unwrap()),
                _ => None,
            },
            _ => None,
        })
        .collect();
    assert_eq!(plans, std::slice::from_ref(&sent));

    // The replay shows it too, with its stamps.
    let replay = Replay::start(&with_plans).unwrap();
    let channel = Channel::from_shared(format!("http://{}", replay.grpc)).unwrap().connect().await.unwrap();
    let mut updates = watch_with_plans(channel).await;
    let mut replayed = replay.client().await.unwrap().subscribe(Subscription::default()).await.unwrap();
    let (map, plan) = loop {
        let (map, plan) = next(&mut updates).await;
        if let Some(plan) = plan {
            break (map, plan);
        }
    };
    assert_eq!((&plan.x, plan.map_sequence), (&sent.x, sent.map_sequence));
    let header = map.header();
    let shift_ns = header.replay.expect("a replay as live").shift_ns;
    assert_eq!(plan.stamp_ns - sent.stamp_ns, shift_ns);
    // A reader that is sent the map of the plan just now gets the plan with it.
    assert!(map.sequence() >= sent.map_sequence.unwrap());
    within("a map", replayed.next()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_plan_that_cannot_be_drawn_is_refused_with_its_value_and_counted_once() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(config(), &folder.path().join("car.mcap")).await;
    feed(&running, readings(2)).await;
    let client = client(&running).await;
    let good = ahead(&newest(&client).await);
    let mut service = PlanServiceClient::new(channel(&running).await);
    let mut send = async |plan: v1::Plan| within("an answer", service.send(plan)).await;
    let long = vec![0.0; 4097];
    let bad = [
        (v1::Plan { frame: 0, ..good.clone() }, "frame 0"),
        (v1::Plan { x: vec![], y: vec![], ..good.clone() }, "path of 0 points: 1 to 4096 are allowed"),
        (v1::Plan { x: long.clone(), y: long, ..good.clone() }, "path of 4097 points"),
        (v1::Plan { x: vec![0.0, f64::NAN, 1.0], ..good.clone() }, "x[1] is NaN"),
        (v1::Plan { stamp_ns: now_ns() + 20_000_000_000, ..good.clone() }, "ahead of the clock"),
    ];
    let count = bad.len() as u64;
    for (plan, text) in bad {
        let status = send(plan).await.unwrap_err();
        assert!(status.code() == Code::InvalidArgument && status.message().contains(text), "{status}");
    }
    assert_eq!(refused(&running), count);
    let status = send(v1::Plan { vehicle: "van".into(), ..good.clone() }).await.unwrap_err();
    assert_eq!((status.code(), status.message()), (Code::NotFound, r#"vehicle "van" is not known; known: car"#));
    // The client says so without a server.
    let empty = client.send_plan(&v1::Plan { x: vec![], y: vec![], ..good.clone() }).await;
    assert!(matches!(empty, Err(ClientError::Plan(PlanError::Points { points: 0 }))), "{empty:?}");
    let mut outcomes = Vec::new();
    while outcomes.last().is_none_or(Result::is_ok) {
        outcomes.push(send(good.clone()).await);
    }
    let status = outcomes.pop().unwrap().unwrap_err();
    assert!(status.code() == Code::ResourceExhausted && outcomes.len() >= 20, "{status} after {}", outcomes.len());
    assert_eq!(refused(&running), count + 1);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_plan_over_zenoh_is_taken_or_counted() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config();
    config.zenoh.enabled = true;
    let running = start(config, &folder.path().join("car.mcap")).await;
    feed(&running, readings(2)).await;
    let good = ahead(&newest(&client(&running).await).await);
    let planner = within("zenoh", ZenohClient::connect(&running.zenoh[0])).await.unwrap();
    let plans = running.vehicles.0[0].wires.plans.subscribe();
    within("zenoh", planner.send_plan(&good)).await.unwrap();
    until("the plan is taken", || plans.borrow().as_deref() == Some(&good)).await;
    let mut config = zenoh::Config::default();
    let endpoint = format!("[{:?}]", running.zenoh[0]);
    for (key, value) in
        [("mode", "'client'"), ("scouting/multicast/enabled", "false"), ("connect/endpoints", &endpoint)]
    {
        config.insert_json5(key, value).unwrap();
    }
    let session = within("zenoh", async { zenoh::open(config).await }).await.unwrap();
    let of_another = v1::Plan { vehicle: "van".into(), ..good.clone() }.encode_to_vec();
    let nowhere = v1::Plan { x: vec![], y: vec![], ..good.clone() }.encode_to_vec();
    for (count, bytes) in (1..).zip([of_another, nowhere, vec![0xff], vec![0; 200_000]]) {
        let put = session.put("clearway/car/plan", bytes).congestion_control(CongestionControl::Block);
        within("zenoh", async { put.await }).await.unwrap();
        until("the refusal is counted", || refused(&running) == count).await;
    }
    // More plans at once than may wait: plans that the rate cannot have let through are counted.
    let (began, before, good) = (Instant::now(), refused(&running), good.encode_to_vec());
    for _ in 0..1000 {
        let put = session.put("clearway/car/plan", good.clone()).congestion_control(CongestionControl::Block);
        within("zenoh", async { put.await }).await.unwrap();
    }
    let taken_max = || 21 + began.elapsed().as_secs() * 20 + 20;
    until("each is taken or counted", || refused(&running) - before + taken_max() >= 1000).await;
    within("shutdown", running.shutdown()).await.unwrap();
}
