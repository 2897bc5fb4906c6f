//! The files in `client/ros2`: parameters of Nav2, and the configuration of RViz.

use std::path::Path;

use clearway_daemon::config::{COMMENTED, Config};
use clearway_daemon::viewer::ros::topics_of;
use clearway_tests::workspace;
use serde_yaml_ng::Value;

use super::CELL_M;

/// A file of `client/ros2`.
fn yaml(name: &str) -> Value {
    let path = workspace().join("client/ros2").join(name);
    serde_yaml_ng::from_str(&std::fs::read_to_string(path).expect("the file")).expect("YAML")
}

/// The parameters of a costmap of Nav2.
pub(super) fn parameters(costmap: &str) -> Value {
    yaml("nav2_costmaps.yaml")[costmap][costmap]["ros__parameters"].clone()
}

/// The parameters that Nav2 declares, by plugin: `declare_parameter` and `declareParameter` in
/// `nav2_costmap_2d/src/costmap_2d_ros.cpp` and `nav2_costmap_2d/plugins` of ros-navigation/navigation2.
const DECLARED: [(&str, &str); 4] = [
    (
        "costmap",
        "always_send_full_costmap map_vis_z footprint_padding footprint global_frame height lethal_cost_threshold origin_x \
         origin_y plugins filters publish_frequency resolution robot_base_frame robot_radius rolling_window \
         track_unknown_space transform_tolerance initial_transform_timeout trinary_costmap unknown_cost_value \
         update_frequency use_maximum width",
    ),
    (
        "nav2_costmap_2d::StaticLayer",
        "plugin enabled subscribe_to_updates footprint_clearing_enabled map_topic map_subscribe_transient_local",
    ),
    (
        "nav2_costmap_2d::ObstacleLayer",
        "plugin enabled footprint_clearing_enabled min_obstacle_height max_obstacle_height combination_method \
         observation_sources",
    ),
    (
        "nav2_costmap_2d::InflationLayer",
        "plugin enabled inflation_radius cost_scaling_factor inflate_unknown inflate_around_unknown",
    ),
];
/// The parameters of a source of observations.
const OF_SOURCE: &str = "topic sensor_frame observation_persistence expected_update_rate data_type min_obstacle_height \
     max_obstacle_height inf_is_valid marking clearing obstacle_max_range obstacle_min_range raytrace_max_range \
     raytrace_min_range";

/// Whether a topic of the vehicle `car` is latched; `None` if there is no such topic.
fn is_latched(topic: &str) -> Option<bool> {
    let (layer, ending) = topic.strip_prefix("/clearway/car/")?.split_once('/').map_or_else(
        || (topic.rsplit('/').next().unwrap_or_default(), String::new()),
        |(layer, ending)| (layer, format!("/{ending}")),
    );
    if (layer, ending.as_str()) == ("plan", "") {
        return Some(true);
    }
    Some(topics_of(layer).iter().find(|topic| topic.ending == ending)?.is_latched)
}

/// The keys of a table without the nested tables.
fn keys(table: &Value) -> Vec<&str> {
    let entries = table.as_mapping().expect("a table").iter();
    entries.filter(|(_, value)| !value.is_mapping()).map(|(key, _)| key.as_str().expect("a name")).collect()
}

#[test]
fn nav2_declares_every_parameter_of_the_file_and_every_topic_is_published() {
    let declared = |plugin: &str| DECLARED.iter().find(|(name, _)| *name == plugin).expect("a known plugin").1;
    let check = |table: &Value, allowed: &str| {
        for key in keys(table) {
            assert!(allowed.split_whitespace().any(|name| name == key), "Nav2 declares no {key}");
        }
    };
    for costmap in ["local_costmap", "global_costmap"] {
        let parameters = parameters(costmap);
        check(&parameters, declared("costmap"));
        assert_eq!(parameters["track_unknown_space"], Value::Bool(true), "unknown is never free");
        assert_eq!(parameters["rolling_window"], Value::Bool(true));
        assert!(parameters["resolution"].as_f64().expect("metres") < CELL_M);
        let plugins: Vec<_> = parameters["plugins"].as_sequence().expect("names").iter().collect();
        for plugin in &plugins {
            let layer = &parameters[*plugin];
            check(layer, declared(layer["plugin"].as_str().expect("a class")));
            if let Some(topic) = layer.get("map_topic") {
                assert_eq!(is_latched(topic.as_str().expect("a topic")), Some(true));
            }
            let sources = layer.get("observation_sources").and_then(Value::as_str).unwrap_or_default();
            for source in sources.split_whitespace().map(|source| &layer[source]) {
                check(source, OF_SOURCE);
                assert_eq!(is_latched(source["topic"].as_str().expect("a topic")), Some(false));
                // Behind it nothing is marked or cleared: the corner of the layer.
                let ranges = ["obstacle_max_range", "raytrace_max_range"].iter().filter_map(|key| source.get(key));
                assert!(
                    ranges.map(|range| range.as_f64().expect("metres")).all(|range_m| range_m > 64.0 * 2_f64.sqrt())
                );
                assert!(source["expected_update_rate"].as_f64().expect("seconds") > 0.3, "the validity of a map");
            }
        }
        // Remembered free cells would cover a grid that became unknown.
        let names: Vec<_> = plugins.iter().filter_map(|plugin| plugin.as_str()).collect();
        assert!(!(names.contains(&"static_layer") && names.contains(&"obstacle_layer")), "{names:?}");
    }
}

#[test]
fn rviz_subscribes_to_published_topics_with_their_durability_and_the_guide_sets_known_keys() {
    let rviz = yaml("clearway.rviz");
    let displays = rviz["Visualization Manager"]["Displays"].as_sequence().expect("displays");
    let topics: Vec<_> = displays.iter().filter_map(|display| display.get("Topic")).collect();
    assert_eq!(topics.len(), 5);
    for topic in topics {
        let name = topic["Value"].as_str().expect("a topic");
        let durability = if is_latched(name).expect(name) { "Transient Local" } else { "Volatile" };
        assert_eq!(topic["Durability Policy"].as_str(), Some(durability), "{name}");
    }
    let guide = std::fs::read_to_string(workspace().join("client/ros2/README.md")).expect("the guide");
    let words: Vec<_> = guide.split_whitespace().map(|word| word.trim_matches(['`', ':', '\'', '.'])).collect();
    let set: Vec<_> = words.windows(2).filter(|pair| pair[0] == "--set").map(|pair| pair[1].to_owned()).collect();
    assert_eq!(set.len(), 9, "{set:?}");
    let config = Config::parse(COMMENTED, Path::new("clearway.toml"), &set).expect("known keys");
    assert!(config.zenoh.ros2.enabled && config.zenoh.ros2.dds_bridge && config.zenoh.ros2.tf);
}
