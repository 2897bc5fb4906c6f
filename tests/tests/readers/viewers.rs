//! ROS 2 and Foxglove clients that use nothing of Clearway: they find the maps, decode them by the published schemas,
//! and have the same cells as the maps.

use std::f64::consts::FRAC_PI_4;
use std::io::{BufRead, BufReader};
use std::process::Stdio;

use clearway_client::{MapView, SafePoint};
use clearway_daemon::config::{Config, Foxglove, Ros2};
use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::run::{Running, Server, Setup};
use clearway_daemon::status::Transport;
use clearway_daemon::viewer::Raster;
use clearway_daemon::viewer::aligned::AlignedGrid;
use clearway_mapping::event::{Body, EgoPose};
use clearway_proto::v1;
use clearway_tests::workspace;
use nalgebra::{Isometry3, Vector3};
use serde_json::{Value, json};
use zenoh::handlers::FifoChannelHandler;
use zenoh::query::ReplyKeyExpr;
use zenoh::sample::Sample;
use zenoh_ext::{AdvancedSubscriber, AdvancedSubscriberBuilderExt, HistoryConfig};

use crate::fixture::{LAYERS, before_another_look, config, feed, readings, start, venv, within};

/// A pose that heads north-east.
fn pose() -> Isometry3<f64> {
    Isometry3::new(Vector3::new(7.0, -3.0, 0.5), Vector3::z() * FRAC_PI_4)
}

/// Sends poses of a vehicle at rest that heads north-east, from 0.2 s before the readings to 0.2 s after them.
async fn send_poses(running: &Running, readings: &[Reading]) {
    let (first_ns, last_ns) = (readings[0].arrival_ns, readings[readings.len() - 1].arrival_ns);
    let pose = |stamp_ns| {
        let body = Body::EgoPose(EgoPose { stamp_ns, map_from_ego: pose(), speed_mps: 0.0 });
        Reading { arrival_ns: first_ns, source: 0, body }
    };
    let poses: Vec<_> = (first_ns - 200_000_000..last_ns + 200_000_000).step_by(50_000_000).map(pose).collect();
    let queue = running.inputs[0].queue.clone();
    let pushed = tokio::task::spawn_blocking(move || poses.into_iter().try_for_each(|pose| queue.push_captured(pose)));
    pushed.await.unwrap().unwrap();
}

fn newest(running: &Running) -> MapView {
    let map = running.vehicles.0[0].newest.borrow().clone().expect("a map");
    MapView::decode(map.select(&[])).unwrap()
}

fn ros2() -> Config {
    let mut config = config();
    config.zenoh.enabled = true;
    config.zenoh.ros2 = Ros2 { enabled: true, domain: 7, tf: true, ..Ros2::default() };
    // The test compares the grids of the newest map, long after its last scan.
    config.vehicles[0].maps.valid_ms = 60_000;
    config
}

/// Compares to a billionth.
#[track_caller]
fn assert_near(found: &Value, expected: &[f64]) {
    let found: Vec<f64> = found.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect();
    let near = found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9);
    assert!(near, "{found:?} is not {expected:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
async fn a_late_ros_2_subscriber_receives_every_layer_and_the_transform() {
    let running = start(ros2()).await;
    let readings = readings(4);
    send_poses(&running, &readings).await;
    feed(&running, readings).await;
    // As at the end of a replay.
    running.vehicles.0[0].wires.replay_ended.send_replace(true);
    let plan = newest(&running).plan("tester", &[[0.0, 0.0], [5.0, 1.0]]);
    running.vehicles.0[0].wires.plans.send(&plan).unwrap();
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens").clone();
    let received = tokio::task::spawn_blocking(move || {
        venv::run(venv::script("ros_topics.py").args([&endpoint, "7"]), "the script names what it missed")
    });
    let received: Value = serde_json::from_str(&received.await.unwrap()).unwrap();

    let map = newest(&running);
    assert_eq!(map.layers().len() as u64, LAYERS);
    assert_eq!(received["topics"].as_object().unwrap().len() as u64, LAYERS + 8);
    assert_eq!(received["messages"]["/clearway/car/replay_ended"]["data"], true);
    let path = &received["messages"]["/clearway/car/plan"];
    assert_eq!((&path["frame_id"], &path["poses"]), (&json!("car/base_link"), &json!([[0.0, 0.0], [5.0, 1.0]])));
    let states = &received["messages"]["/diagnostics"]["states"];
    let known = states["clearway: car"].as_array().expect("a state of car");
    // A loss is stated only while packets are expected.
    let mut values: Vec<_> = known[2].as_array().expect("names of values").clone();
    values.retain(|name| name != "loss");
    assert_eq!(json!([known[1], values]), json!(["car", ["map_age_ms", "map_rate_hz"]]));
    for cloud in ["obstacles", "ground"] {
        let topic = format!("/clearway/car/freespace/{cloud}");
        let message = &received["messages"][&topic];
        assert_eq!(received["topics"][&topic]["qos"], "1:2:1,100:,:,:,,", "{topic}");
        assert_eq!(
            (&message["frame_id"], &message["stamp_ns"]),
            (&json!("car/base_link"), &json!(map.header().capture_end_ns))
        );
        assert_eq!(message["points"].as_u64().unwrap() > 500, cloud == "ground", "a plain with some things: {message}");
    }
    let mut gids = Vec::new();
    for layer in map.layers() {
        let topic = format!("/clearway/car/{}", layer.name);
        assert_eq!(received["topics"][&topic]["qos"], "1:1:1,1:,:,:,,", "{topic}");
        let (grid, raster) = (&received["messages"][&topic], Raster::from_grid(&layer.grid));
        let placed = AlignedGrid::new(&raster, &raster.occupancies(layer), &pose());
        assert_eq!(grid["frame_id"], "map", "{topic}");
        assert_eq!(grid["stamp_ns"], map.header().capture_end_ns, "{topic}");
        assert_eq!(grid["size"], json!([placed.width, placed.height]), "{topic}");
        assert_near(&grid["origin"], &[placed.origin_m[0], placed.origin_m[1], 0.0, 1.0]);
        assert_eq!(grid["sequence"], 1, "{topic}: the second subscriber has it from the cache");
        // The grades of free cells are the clearance, and other cells have none.
        let data: Vec<i64> = grid["data"].as_array().unwrap().iter().map(|value| value.as_i64().unwrap()).collect();
        let graded = data.iter().any(|value| (1..=50).contains(value));
        assert_eq!(graded, layer.name == "freespace", "{topic}");
        let classes = data.iter().map(|&value| if (1..=50).contains(&value) { 0 } else { value as i8 });
        assert!(classes.eq(placed.occupancies), "{topic}");
        assert!(data.contains(&0), "{topic}: the map has clear ground around a vehicle on a plain");
        gids.push(grid["gid"].as_str().unwrap());
    }
    let points = &map.layer("safe_path").unwrap().points;
    assert!(points.len() > 10, "{} safe points", points.len());
    let [markers, poses] = ["markers", "poses"].map(|kind| format!("/clearway/car/safe_path/{kind}"));
    for topic in [&markers, &poses] {
        let message = &received["messages"][topic];
        assert_eq!(received["topics"][topic]["qos"], "1:1:1,1:,:,:,,", "{topic}");
        assert_eq!(message["stamp_ns"], map.header().capture_end_ns, "{topic}");
        assert_eq!(message["frame_id"], "car/base_link", "{topic}");
        gids.push(message["gid"].as_str().unwrap());
    }
    let place = |point: &SafePoint| [point.x_m, point.y_m].map(f64::from);
    let places: Vec<_> = points.iter().map(place).collect();
    let links: Vec<_> =
        points.iter().flat_map(|from| from.links.iter().flat_map(|&to| [place(from), places[to as usize]])).collect();
    assert_eq!(received["messages"][&poses]["poses"], json!(places));
    assert_eq!(received["messages"][&markers]["lines"]["links"], json!(links));
    assert!(!received["messages"][&markers]["lines"]["radii"].as_array().unwrap().is_empty());
    gids.sort_unstable();
    gids.dedup();
    assert_eq!(gids.len() as u64, LAYERS + 2, "each publisher has its own gid");
    let (sin, cos) = (-FRAC_PI_4 / 2.0).sin_cos();
    assert_eq!(received["messages"]["/tf"]["frames"], json!(["map", "car/base_link"]));
    assert_near(&received["messages"]["/tf"]["pose"], &[7.0, -3.0, 0.5, 0.0, 0.0, -sin, cos]);
    within("shutdown", running.shutdown()).await.unwrap();
}

/// True if a grid has a known cell.
fn is_known(grid: &Sample) -> bool {
    // Header, info and count end before the cells; the last cells are in a corner.
    grid.payload().to_bytes()[200..].iter().any(|&value| value != u8::MAX)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_grid_of_a_sensor_that_stops_becomes_unknown_once_and_a_late_subscriber_gets_no_other() {
    let mut config = ros2();
    // No grid takes so long to make.
    config.vehicles[0].maps.valid_ms = 3000;
    config.zenoh.ros2.dds_bridge = true;
    let running = start(config).await;
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens").clone();
    let mut client = zenoh::Config::default();
    client.insert_json5("mode", "\"client\"").unwrap();
    client.insert_json5("connect/endpoints", &format!("[{endpoint:?}]")).unwrap();
    client.insert_json5("scouting/multicast/enabled", "false").unwrap();
    let session = within("zenoh", zenoh::open(client).into_future()).await.unwrap();
    let subscribe = async || {
        let history = HistoryConfig::default().detect_late_publishers();
        session.declare_subscriber("clearway/car/freespace").history(history).await.unwrap()
    };
    // Stamp in ns, and whether the grid has a known cell.
    let next = async |subscriber: &AdvancedSubscriber<FifoChannelHandler<Sample>>| {
        let sample = within("a grid", subscriber.recv_async()).await.unwrap();
        let message = sample.payload().to_bytes();
        let stamp_ns = clearway_ros::cdr::Reader::new(&message).unwrap().header().unwrap().stamp_ns;
        (stamp_ns, is_known(&sample))
    };
    let first = subscribe().await;
    let mut fed = readings(4);
    let rest = fed.split_off(fed.len() / 2);
    feed(&running, fed).await;
    let (mut known_ns, mut grid) = (0, next(&first).await);
    while grid.1 {
        (known_ns, grid) = (grid.0, next(&first).await);
    }
    assert_eq!(grid.0, known_ns + 3_000_000_000, "the time at which the newest map became stale");
    let late = subscribe().await;
    assert_eq!(next(&late).await, grid);
    feed(&running, rest).await;
    for subscriber in [&first, &late] {
        let (stamp_ns, known) = next(subscriber).await;
        assert!(known && stamp_ns > known_ns, "the unknown grid came once");
    }
    // The next map becomes stale without a subscriber, and the cache answers whichever subscriber comes then.
    for subscriber in [first, late] {
        subscriber.undeclare().await.unwrap();
    }
    let has_reader = || running.vehicles.0[0].status.transports.count(Transport::Ros) > 0;
    within("no reader", async {
        while has_reader() {
            before_another_look().await
        }
    })
    .await;
    let of_cache = session.get("clearway/car/freespace/@adv/**").accept_replies(ReplyKeyExpr::Any);
    let cached = within("the cache", of_cache.await.unwrap().recv_async()).await.unwrap().into_result().unwrap();
    assert!(!is_known(&cached), "the grid of the cache looks fresh for ever");
    session.close().await.unwrap();
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn no_layer_is_made_for_topics_and_channels_without_subscribers() {
    let mut config = ros2();
    config.foxglove = Foxglove { enabled: true, listen: "127.0.0.1:0".parse().unwrap() };
    let running = Server::start(Setup { config, ..Setup::default() }).await.unwrap();
    assert!(feed(&running, readings(4)).await >= 3);
    assert_eq!(newest(&running).layers(), []);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
async fn a_foxglove_client_gets_the_current_map_and_points_of_later_maps() {
    let mut config = config();
    config.foxglove = Foxglove { enabled: true, listen: "127.0.0.1:0".parse().unwrap() };
    let running = start(config).await;
    let mut readings = readings(8);
    send_poses(&running, &readings).await;
    let rest = readings.split_off(readings.len() / 2);
    feed(&running, readings).await;
    // As at the end of a replay.
    running.vehicles.0[0].wires.replay_ended.send_replace(true);
    let address = format!("ws://{}", running.foxglove.expect("Foxglove is served"));
    let map = newest(&running);
    let plans = &running.vehicles.0[0].wires.plans;
    plans.send(&v1::Plan { text: "blocked".into(), ..map.plan("tester", &[[0.0, 0.0], [5.0, 1.0]]) }).unwrap();

    let (mut client, mut lines) = tokio::task::spawn_blocking(move || {
        let mut client = venv::script("foxglove_live.py").arg(address).stdout(Stdio::piped()).spawn().unwrap();
        let lines = BufReader::new(client.stdout.take().unwrap()).lines();
        (client, lines)
    })
    .await
    .unwrap();
    let (newest_map, lines) =
        tokio::task::spawn_blocking(move || (lines.next().expect("a line").unwrap(), lines)).await.unwrap();
    let newest_map: Value = serde_json::from_str(&newest_map).unwrap();
    assert_eq!(newest_map["name"], "clearway");
    assert_eq!(newest_map["channels"].as_object().unwrap().len() as u64, LAYERS + 5);
    assert_eq!(newest_map["channels"]["/car/log"], "foxglove.Log");
    let layout = std::fs::read_to_string(workspace().join("server/guide/foxglove-layout.json")).expect("the layout");
    let panels = serde_json::from_str::<Value>(&layout).expect("JSON")["configById"].clone();
    let topics = panels["3D!maps"]["topics"].as_object().expect("topics");
    for topic in topics.keys().map(String::as_str).chain(panels["RosOut!states"]["topicToRender"].as_str()) {
        assert!(newest_map["channels"].get(topic).is_some(), "the layout names {topic}");
    }
    assert_eq!(newest_map["/car/log"]["message"], "the replay has ended");
    for name in ["drivability", "occupancy"] {
        let (layer, grid) = (map.layer(name).unwrap(), &newest_map[format!("/car/map/{name}")]);
        let (raster, schema) = (Raster::from_grid(&layer.grid), &newest_map["channels"][format!("/car/map/{name}")]);
        let data = raster.rgba(layer);
        assert_eq!((schema.as_str(), grid["frame_id"].as_str()), (Some("foxglove.Grid"), Some("car/base_link")));
        assert_eq!(grid["log_ns"], map.header().capture_end_ns);
        assert_eq!((&grid["column_count"], &grid["row_stride"]), (&json!(raster.width), &json!(4 * raster.width)));
        assert_eq!(grid["data"], json!({"length": data.len(), "crc32": crc32fast::hash(&data)}), "{name}");
    }
    let plan = &newest_map["/car/plan"]["entities"][0];
    assert_eq!((&plan["frame_id"], &plan["texts"][0]["text"]), (&json!("car/base_link"), &json!("blocked")));
    assert_eq!(plan["lines"][0]["points"].as_array().unwrap().len(), 2, "one straight line");
    let (scene, points) = (&newest_map["/car/safe_points"], &map.layer("safe_path").unwrap().points);
    assert_eq!(newest_map["channels"]["/car/safe_points"], "foxglove.SceneUpdate");
    let (entity, links) = (&scene["entities"][0], points.iter().map(|point| point.links.len()).sum::<usize>());
    assert_eq!(
        (entity["frame_id"].as_str(), &scene["log_ns"]),
        (Some("car/base_link"), &json!(map.header().capture_end_ns))
    );
    assert!(links > 10 && entity["lines"][0]["points"].as_array().unwrap().len() == 2 * links, "{links} links");
    let turned = &newest_map["/car/map/occupancy"]["pose"]["orientation"];
    let (sin, cos) = (-FRAC_PI_4 / 2.0).sin_cos();
    assert_near(&json!([turned["z"], turned["w"]]), &[sin, cos]);
    let transform = &newest_map["/tf"]["transforms"][0];
    assert_eq!((&transform["parent_frame_id"], &transform["child_frame_id"]), (&json!("map"), &json!("car/base_link")));
    assert_near(&json!([transform["translation"]["x"], transform["rotation"]["z"]]), &[7.0, -sin]);

    feed(&running, rest).await;
    let points = tokio::task::spawn_blocking(move || {
        let mut lines = lines;
        let points = lines.next().expect("a line").unwrap();
        assert!(client.wait().unwrap().success());
        points
    });
    let points: Value = serde_json::from_str(&points.await.unwrap()).unwrap();
    assert_eq!((&points["frame_id"], &points["point_stride"]), (&json!("car/base_link"), &json!(12)));
    assert!(points["data"]["length"].as_u64().unwrap() > 12 * 10_000, "{points}");
    assert!(points["log_ns"].as_i64().unwrap() > map.header().capture_end_ns);
    within("shutdown", running.shutdown()).await.unwrap();
}
