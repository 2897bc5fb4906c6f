//! The configuration is complete and strict, and its errors name what is wrong.

use super::*;

/// A configuration with the keys that have no default, and no others.
const NEEDED: &str = "[[vehicle]]\nname = \"car\"\n[vehicle.udp]\n[[vehicle.sensor]]\nname = \"top\"\n\
    [vehicle.sensor.extrinsics]\nx_m = 0.0\ny_m = 0.0\nz_m = 1.9\nroll_deg = 0.0\npitch_deg = 0.0\nyaw_deg = 0.0\n";

fn parse(text: &str) -> Result<Config, ConfigError> {
    Config::parse(text, Path::new("clearway.toml"), &[])
}

fn error(text: &str) -> String {
    parse(text).unwrap_err().to_string()
}

/// The paths of all keys, array items without their index.
fn keys(value: &toml::Value, at: &str, found: &mut BTreeSet<String>) {
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                let at = format!("{at}.{key}");
                found.insert(at.clone());
                keys(value, &at, found);
            }
        }
        toml::Value::Array(items) => items.iter().for_each(|item| keys(item, at, found)),
        _ => {}
    }
}

#[test]
fn the_commented_configuration_holds_every_key_with_its_default() {
    let commented = parse(COMMENTED).unwrap();
    assert_eq!(commented, parse(NEEDED).unwrap());
    let (mut said, mut all) = (BTreeSet::new(), BTreeSet::new());
    keys(&toml::from_str(COMMENTED).unwrap(), "", &mut said);
    keys(&toml::from_str(&commented.to_toml()).unwrap(), "", &mut all);
    let missing: Vec<_> = all.difference(&said).collect();
    assert!(missing.is_empty(), "not in deploy/clearway.toml: {missing:?}");
}

/// The commented configuration with its optional keys and tables, which are comments in it.
fn uncommented() -> String {
    let is_toml = |line: &str| {
        let name = line.split_once(" = ").map_or("", |(name, _)| name);
        let is_key = !name.is_empty() && name.bytes().all(|byte| byte == b'_' || byte.is_ascii_lowercase());
        (is_key || line.starts_with('[')) && toml::from_str::<toml::Table>(line).is_ok()
    };
    let line = |line: &str| match line.strip_prefix("# ").filter(|line| is_toml(line)) {
        Some(optional) => format!("{optional}\n"),
        None => format!("{line}\n"),
    };
    COMMENTED.lines().map(line).collect()
}

#[test]
fn the_commented_configuration_shows_every_optional_key_and_table() {
    let text = uncommented();
    let config = parse(&text).unwrap();
    let (vehicle, tls) = (&config.vehicles[0], config.grpc.tls.as_ref().unwrap());
    let sensor = &vehicle.sensors[0];
    assert!(vehicle.ros.is_some() && vehicle.body.is_some() && tls.client_ca.is_some());
    assert!(sensor.model.is_some() && sensor.rpm.is_some() && sensor.calibration.is_some());
    let udp = vehicle.udp.as_ref().unwrap();
    assert!(udp.from.contains_key("top") && udp.ports.contains_key("top"));
    let (mut shown, mut all) = (BTreeSet::new(), BTreeSet::new());
    keys(&toml::from_str(&text).unwrap(), "", &mut shown);
    keys(&toml::from_str(&config.to_toml()).unwrap(), "", &mut all);
    assert_eq!(all.difference(&shown).collect::<Vec<_>>(), Vec::<&String>::new());
}

/// The keys below `at` that hold a single value or a list of such, and a value of another type for each.
fn wrong_values(value: &toml::Value, at: &str, found: &mut Vec<(String, String)>) {
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                wrong_values(value, &if at.is_empty() { key.clone() } else { format!("{at}.{key}") }, found);
            }
        }
        toml::Value::Array(items) if items.iter().any(toml::Value::is_table) => {
            items.iter().for_each(|item| wrong_values(item, at, found));
        }
        toml::Value::String(_) => found.push((at.to_owned(), "true".into())),
        _ => found.push((at.to_owned(), "\"many\"".into())),
    }
}

#[test]
fn a_value_of_a_wrong_type_is_named_with_key_value_and_what_is_allowed() {
    let text = uncommented();
    let mut wrong = Vec::new();
    wrong_values(&toml::from_str(&text).unwrap(), "", &mut wrong);
    assert!(wrong.len() > 100, "{wrong:?}");
    for (key, value) in wrong {
        // `from.top` of `[vehicle.udp]`, and `vehicle.name`, which then cannot name its vehicle.
        let option = format!("{key}={value}");
        let error = Config::parse(&text, Path::new("a.toml"), std::slice::from_ref(&option)).unwrap_err().to_string();
        let plain = error.replace("[0]", "").replace(" (of car)", "");
        let start = format!("--set {option}: {key} = {value}: allowed: ");
        let allowed = plain.strip_prefix(&start).unwrap_or_else(|| panic!("{option}: {error}"));
        let rust = ["expected", "invalid", "u16", "u32", "u64", "usize", "f32", "f64", "struct ", "variant", "string"];
        assert!(!allowed.is_empty() && rust.iter().all(|word| !allowed.contains(word)), "{option}: {error}");
    }
}

#[test]
fn a_wrong_value_is_named_with_its_line() {
    let refused = error(&format!("[grpc]\nenabled = true\nlisten = \"localhost\"\n{NEEDED}"));
    let start = "configuration clearway.toml, line 3: grpc.listen = \"localhost\": allowed: an address with a port";
    assert!(refused.starts_with(start), "{refused}");
    let refused = error(&NEEDED.replace("name = \"top\"", "name = \"top\"\nmodel = \"hdl64e\""));
    let start = "configuration clearway.toml, line 6: vehicle.sensor[0].model (of car) = \"hdl64e\": allowed: ";
    assert!(refused.starts_with(start) && refused.contains("\"hdl64e_s2\", \"hdl64e_s3\""), "{refused}");
}

#[test]
fn tables_with_the_wrong_number_of_brackets_are_shown_with_the_right_one() {
    let name = "vehicle = (a table): allowed: a list of tables: write [[vehicle]] instead of [vehicle]";
    assert!(
        error(&NEEDED.replace("[[vehicle]]", "[vehicle]").replace("[[vehicle.sensor]]", "[vehicle.sensor]"))
            .contains(name)
    );
    let sensor = error(&NEEDED.replace("[[vehicle.sensor]]", "[vehicle.sensor]"));
    assert!(sensor.contains("write [[vehicle.sensor]] instead of [vehicle.sensor]"), "{sensor}");
    let grpc = error(&format!("[[grpc]]\nenabled = true\n{NEEDED}"));
    assert!(grpc.contains("grpc = (a table): allowed: one table: write [grpc] instead of [[grpc]]"), "{grpc}");
    let udp = error(&NEEDED.replace("[vehicle.udp]", "[[vehicle.udp]]"));
    assert!(udp.contains("write [vehicle.udp] instead of [[vehicle.udp]]"), "{udp}");
    assert!(error("vehicle = 3").contains("vehicle = 3: allowed: a list of tables: write [[vehicle]]"));
}

#[test]
fn an_error_of_an_override_names_the_option_and_not_the_file() {
    let refused = |text: &str, overrides: &[&str]| {
        let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
        Config::parse(text, Path::new("clearway.toml"), &overrides).unwrap_err().to_string()
    };
    for (option, error) in [
        ("grpc.listen=abc", "--set grpc.listen=abc: grpc.listen = \"abc\": allowed: an address with a port"),
        ("grpc.liste=1", "--set grpc.liste=1: grpc.liste is not a key; its table has: enabled, listen"),
        ("vehicle.queue=3", "--set vehicle.queue=3: vehicle.queue (of car) = 3: allowed: 16 to 1048576"),
        ("vehicle.sensor.rpm=1", "--set vehicle.sensor.rpm=1: vehicle.sensor[0].rpm (of car) = 1: allowed: 60 to 2400"),
        ("vehicle.body.x_m_min=-1", "--set vehicle.body.x_m_min=-1: vehicle.body.x_m_max (of car) is missing"),
        ("vehicle.name.first=a", "--set vehicle.name.first=a: vehicle.name is not a table"),
        ("grpc..listen=a", "--set grpc..listen=a: expected KEY=VALUE"),
    ] {
        let refused = refused(NEEDED, &["zenoh.enabled=true", option, "page.enabled=true"]);
        assert!(refused.starts_with(error), "{option}: {refused}");
    }
    // The file is to blame for what no override sets.
    let queue = NEEDED.replace("name = \"car\"", "name = \"car\"\nqueue = 3");
    assert!(refused(&queue, &["page.enabled=true"]).starts_with("configuration clearway.toml: vehicle.queue"));
    // Values that are wrong only beside an override are the fault of the overrides.
    let ros = NEEDED.replace("[vehicle.udp]", "[vehicle.ros]");
    assert!(refused(&ros, &["zenoh.enabled=false"]).starts_with("--set zenoh.enabled=false: vehicle.ros (of car)"));
}

#[test]
fn the_effective_configuration_parses_to_itself() {
    let config = parse(COMMENTED).unwrap();
    assert_eq!(parse(&config.to_toml()).unwrap(), config);
}

#[test]
fn an_unknown_key_is_refused_with_file_and_line() {
    let error = error(&format!("[grpc]\nlisten = \"127.0.0.1:1\"\nliste = 3\n{NEEDED}"));
    assert!(error.contains("clearway.toml") && error.contains("line 3") && error.contains("liste"), "{error}");
    assert!(error.contains("enabled"), "what is allowed: {error}");
}

#[test]
fn a_value_out_of_bounds_is_named_with_file_key_and_allowed_values() {
    let wrong = [
        ("name = \"car\"", "name = \"The Car\"", "The Car"),
        ("z_m = 1.9", "z_m = 1900.0", "0.1 to 20"),
        ("name = \"car\"", "name = \"car\"\nqueue = 3", "16 to 1048576"),
        ("[vehicle.udp]", "[vehicle.udp]\nfrom = { roof = \"10.0.0.1\" }", "top"),
        ("[vehicle.udp]", "[vehicle.udp]\nports = { roof = { data = 1, telemetry = 2 } }", "top"),
        ("[vehicle.udp]", "[vehicle.udp]\nports = { top = { data = 70000, telemetry = 2 } }", "0 to 65535"),
        ("[vehicle.udp]", "[vehicle.udp]\ngroups = [\"10.0.0.1\"]", "multicast"),
        ("[vehicle.udp]", "[vehicle.udp]\ngroups = [\"ff02::1\"]", "multicast"),
        ("[[vehicle]]", "[zenoh]\nlisten = [\"quic/1.2.3.4:1\"]\n[[vehicle]]", "tcp/127.0.0.1:7447"),
        ("[[vehicle]]", "[zenoh]\nenabled = true\nmode = \"client\"\n[[vehicle]]", "the endpoint of a router"),
        ("[[vehicle]]", "[recorder]\nflush_ms = 1\n[[vehicle]]", "10 to 60000"),
        ("[[vehicle]]", "[recorder]\nmaps = \"some\"\n[[vehicle]]", "full"),
        ("[[vehicle]]", "[store]\nurl = \"ftp://a/b\"\n[[vehicle]]", "s3://BUCKET/PREFIX"),
        ("[[vehicle]]", "[store]\nurl = \"s3:///prefix\"\n[[vehicle]]", "s3://BUCKET/PREFIX"),
        ("[[vehicle]]", "[store]\nurl = \"file://mnt\"\n[[vehicle]]", "file:///FOLDER"),
        ("[[vehicle]]", "[recorder]\nfile = \"a\"\nwarm_up_ms = 500\n[[vehicle]]", "at least the 5 s"),
    ];
    for (from, to, allowed) in wrong {
        let error = error(&NEEDED.replacen(from, to, 1));
        assert!(error.contains("clearway.toml") && error.contains(allowed), "{to}: {error}");
    }
    for url in ["", "/mnt/archive", "file:///mnt/archive", "s3://fleet", "s3://fleet/clearway"] {
        assert!(Store { url: url.into(), ..Store::default() }.check().is_ok(), "{url}");
    }
    assert!(error("").contains("at least one [[vehicle]]"));
    assert!(error(&NEEDED.replace("z_m = 1.9\n", "")).contains("z_m"), "a missing transform is an error");
    assert!(error(&format!("{NEEDED}{NEEDED}")).contains("a different name for each vehicle"));
}

#[test]
fn a_limit_of_a_name_without_access_is_refused() {
    let config = |names: &str| {
        let tls = "[grpc.tls]\ncertificate = \"a.pem\"\nkey = \"a.key\"\nclient_ca = \"ca.pem\"\n";
        let only = "[grpc.access.only]\nplanner = { vehicles = [\"car\"] }\n";
        parse(&format!("{tls}[grpc.access]\n{names}\n{only}{NEEDED}"))
    };
    let refused = config("readers = [\"planer\"]").unwrap_err().to_string();
    assert!(refused.contains("grpc.access.only = planner: allowed: a name of readers"), "{refused}");
    for names in ["readers", "ingesters", "operators"].map(|list| format!("{list} = [\"planner\"]")) {
        config(&names).unwrap();
    }
    config("tokens = { planner = \"planner.token\" }").unwrap();
}

#[test]
fn an_invalid_calibration_file_is_named_before_the_server_starts() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("clearway.toml");
    let text = NEEDED.replace("name = \"top\"", "name = \"top\"\ncalibration = \"top.yaml\"");
    let config = Config::parse(&text, &file, &[]).unwrap();
    let missing = config.calibrations(&file).unwrap_err().to_string();
    assert!(missing.contains("top.yaml") && missing.contains("vehicle.sensor.calibration"), "{missing}");
    std::fs::write(folder.path().join("top.yaml"), "lasers: [{laser_id: nine}]").unwrap();
    let wrong = config.calibrations(&file).unwrap_err().to_string();
    assert!(wrong.contains("laser_id") && wrong.contains("nine"), "{wrong}");
}

#[test]
fn relative_paths_start_at_the_configurations_folder() {
    let text = format!("[zenoh]\nfile = \"zenoh/server.json5\"\n[recorder]\nfile = \"/var/drive.mcap\"\n{NEEDED}");
    let config = parse(&text).unwrap();
    let located = config.clone().located(Path::new("/etc/clearway/clearway.toml"));
    assert_eq!(located.zenoh.file, Path::new("/etc/clearway/zenoh/server.json5"));
    assert_eq!(located.recorder.file, Path::new("/var/drive.mcap"));
    assert_eq!(config.clone().located(Path::new("clearway.toml")), config, "in the working directory");
    let none = parse(NEEDED).unwrap().located(Path::new("/etc/clearway/clearway.toml"));
    assert_eq!(
        (none.zenoh.file, none.recorder.file),
        (std::path::PathBuf::new(), std::path::PathBuf::new()),
        "none is none"
    );
}

#[test]
fn an_override_takes_precedence_over_the_file() {
    let set = |text: &str| Config::parse(NEEDED, Path::new("clearway.toml"), &[text.to_owned()]);
    assert_eq!(set("grpc.listen=0.0.0.0:9").unwrap().grpc.listen.port(), 9);
    assert!(!set("zenoh.enabled = false").unwrap().zenoh.enabled);
    assert_eq!(set("vehicle.maps.drivability.columns=180").unwrap().vehicles[0].maps.drivability.columns, 180);
    assert!(set("grpc.liste=1").is_err());
    assert!(matches!(set("nonsense"), Err(ConfigError::Override { .. })));
}

#[test]
fn a_sender_is_an_address_or_a_socket() {
    let from =
        |text: &str| parse(&NEEDED.replace("[vehicle.udp]", &format!("[vehicle.udp]\nfrom = {{ top = {text:?} }}")));
    let sender = |text: &str| from(text).unwrap().vehicles[0].udp.clone().unwrap().from["top"];
    assert!(sender("10.0.0.1").matches("10.0.0.1:77".parse().unwrap()));
    assert!(!sender("10.0.0.1:78").matches("10.0.0.1:77".parse().unwrap()));
    assert!(from("the roof").unwrap_err().to_string().contains("192.168.1.201"));
}

/// A car and a truck at the default ports, each with this `[vehicle.udp]`.
fn two(car: &str, truck: &str) -> Result<Config, ConfigError> {
    let one = |name: &str, udp: &str| NEEDED.replace("\"car\"", name).replace("[vehicle.udp]", udp);
    parse(&(one("\"car\"", &format!("[vehicle.udp]\n{car}")) + &one("\"truck\"", &format!("[vehicle.udp]\n{truck}"))))
}

#[test]
fn vehicles_share_a_socket_if_their_senders_differ() {
    let config = two("from.top = \"10.0.0.1\"", "from.top = \"10.0.0.2:2368\"\ngroups = [\"239.1.2.3\"]").unwrap();
    let sockets = listeners(&config.vehicles);
    assert_eq!(sockets.iter().map(|s| s.at.port()).collect::<Vec<_>>(), [2368, 8308]);
    assert_eq!(sockets[0].groups.len(), 1);
    let vehicle = |peer: &str| sockets[0].route(peer.parse().unwrap()).map(|route| (route.vehicle, route.source));
    assert_eq!(vehicle("10.0.0.1:7"), Some((0, 0)));
    assert_eq!(vehicle("10.0.0.2:2368"), Some((1, 0)));
    assert_eq!((vehicle("10.0.0.2:7"), vehicle("10.0.0.3:2368")), (None, None));

    let ports = two("", "ports.top = { data = 2369, telemetry = 2369 }").unwrap();
    let sockets = listeners(&ports.vehicles);
    let heard: Vec<_> = sockets.iter().map(|s| (s.at.port(), s.routes[0].vehicle, s.routes.len())).collect();
    assert_eq!(heard, [(2368, 0, 1), (8308, 0, 1), (2369, 1, 1)]);
}

#[test]
fn sensors_that_cannot_be_distinguished_are_refused() {
    for (car, truck) in [
        ("", ""),
        ("from.top = \"10.0.0.1\"", ""),
        ("from.top = \"10.0.0.1\"", "from.top = \"10.0.0.1:2368\""),
        ("ports.top = { data = 8308, telemetry = 1 }", ""),
    ] {
        let error = two(car, truck).unwrap_err().to_string();
        assert!(error.contains("top of car and top of truck cannot be distinguished"), "{error}");
    }
}

#[test]
fn the_commented_ros_table_is_valid_and_wrong_topics_are_named() {
    let text = uncommented();
    let from = text.find("[vehicle.ros]").unwrap();
    let block: String =
        text[from..].lines().take_while(|line| !line.is_empty()).map(|line| format!("{line}\n")).collect();
    let head = "[[vehicle]]\nname = \"car\"\n";
    let sensor = NEEDED.split_once("[vehicle.udp]\n").unwrap().1;
    let parse = |ros: &str, set: &[String]| Config::parse(&format!("{head}{ros}{sensor}"), Path::new("a.toml"), set);
    let ros = parse(&block, &[]).unwrap().vehicles[0].ros.clone().unwrap();
    let expected =
        Ros { pose: "/odom".into(), sensors: [("top".into(), "/velodyne_points".into())].into(), ..Ros::default() };
    assert_eq!(ros, expected);
    for (set, said) in [
        ("vehicle.ros.pose=odom", "vehicle.ros (of car) = odom: allowed: topics such as"),
        ("vehicle.ros.pose=/velodyne_points", "vehicle.ros (of car) = /velodyne_points: allowed: each topic once"),
        ("vehicle.ros.sensors.left=/a", "vehicle.ros.sensors (of car) = left: allowed: the vehicle's sensors: top"),
        ("vehicle.ros.domain=233", "vehicle.ros.domain (of car) = 233: allowed: 0 to 232"),
        ("zenoh.enabled=false", "vehicle.ros (of car) = (set): allowed: only with zenoh.enabled = true"),
    ] {
        let error = parse(&block, &[set.to_owned()]).unwrap_err().to_string();
        assert!(error.contains(said), "{error}");
    }
}

#[test]
fn names_that_ros_2_does_not_allow_are_refused_if_ros2_is_enabled() {
    let ros2 = |ros2: &str| format!("[zenoh.ros2]\n{ros2}\n{NEEDED}");
    let names = NEEDED.replace("\"car\"", "\"4-wheeler\"");
    assert!(parse(&names).is_ok());
    let refused = error(&format!("[zenoh.ros2]\nenabled = true\n{names}"));
    assert!(refused.contains("vehicle.name = 4-wheeler") && refused.contains("no digit first"), "{refused}");
    for (key, value, allowed) in [
        ("namespace", "\"clearway\"", "such as \"/clearway\", or empty"),
        ("namespace", "\"/\"", "such as \"/clearway\", or empty"),
        ("namespace", "\"/fleet/7\"", "such as \"/clearway\", or empty"),
        ("domain", "233", "0 to 232"),
    ] {
        let refused = error(&ros2(&format!("enabled = true\n{key} = {value}")));
        assert!(refused.contains(&format!("zenoh.ros2.{key}")) && refused.contains(allowed), "{refused}");
    }
    assert!(parse(&ros2("enabled = true\nnamespace = \"\"")).is_ok());
    let refused = error(&format!("[zenoh]\nenabled = false\n{}", ros2("enabled = true")));
    assert!(refused.contains("zenoh.ros2.enabled = true: allowed: only with zenoh.enabled = true"), "{refused}");
}

#[test]
fn an_address_that_other_hosts_can_reach_needs_protection_or_its_name_in_words() {
    let exposed = |text: &str| {
        let config = Config::parse(NEEDED, Path::new("a.toml"), &[text.to_owned()]).unwrap();
        config.check_exposure(Path::new("a.toml"), &[text.to_owned()]).err().map(|error| error.to_string())
    };
    assert_eq!(exposed("grpc.enabled=true"), None);
    for (setting, service) in [
        ("grpc.listen=0.0.0.0:1", "grpc"),
        ("grpc.listen=[::]:1", "grpc"),
        ("page.listen=192.168.1.7:80", "page"),
        ("metrics={ enabled = true, listen = \"0.0.0.0:1\" }", "metrics"),
        ("foxglove={ enabled = true, listen = \"0.0.0.0:1\" }", "foxglove"),
        ("zenoh.listen=[\"tcp/0.0.0.0:7447\"]", "zenoh"),
        ("zenoh.listen=[\"tcp/[::]:7447\"]", "zenoh"),
        ("vehicle.udp.data=0.0.0.0:2368", "udp"),
    ] {
        let refused = exposed(setting).unwrap_or_else(|| panic!("{setting} is accepted"));
        let allowed = format!("connections.unprotected = [\"{service}\"]");
        assert!(refused.starts_with(&format!("--set {setting}: ")) && refused.contains(&allowed), "{refused}");
        let options = [setting.to_owned(), format!("connections.unprotected=[\"{service}\"]")];
        Config::parse(NEEDED, Path::new(""), &options).unwrap().check_exposure(Path::new(""), &options).unwrap();
    }
    for allowed in [
        "zenoh.listen=[\"tcp/localhost:7447\", \"tcp/[::1]:7447\", \"tcp/127.0.0.1:7447\"]",
        "foxglove={ enabled = false, listen = \"0.0.0.0:1\" }",
        "vehicle.udp={ data = \"0.0.0.0:2368\", telemetry = \"0.0.0.0:8308\", from = { top = \"10.0.0.1\" } }",
    ] {
        assert_eq!(exposed(allowed), None, "{allowed}");
    }
}

#[test]
fn a_reload_changes_certificates_roles_and_limits_and_nothing_else() {
    let config = |option: &str| Config::parse(NEEDED, Path::new("a.toml"), &[option.to_owned()]).unwrap();
    let old = config("grpc.enabled=true");
    let changed = |option: &str| differing_keys(&config(option).without_reloaded(&old).to_toml(), &old.to_toml());
    for reloaded in ["connections.max=7", "connections.per_address_max=7", "connections.hosts=[\"car.example\"]"] {
        assert!(changed(reloaded).is_empty(), "{reloaded}");
    }
    assert!(changed("grpc.listen=127.0.0.1:7").iter().eq(["grpc.listen"]));
    assert!(changed("zenoh.enabled=false").iter().eq(["zenoh.enabled"]));
}

/// Three vehicles with common keys; `third` has two sensors of its own.
const FLEET: &str = "[vehicle_defaults]\nqueue = 64\n[vehicle_defaults.udp]\ndata = \"127.0.0.1:0\"\n\
    telemetry = \"127.0.0.1:0\"\n[[vehicle_defaults.sensor]]\nname = \"top\"\nmodel = \"vlp16\"\n[vehicle_defaults.sensor.extrinsics]\nx_m = 0.0\n\
    y_m = 0.0\nz_m = 1.9\nroll_deg = 0.0\npitch_deg = 0.0\nyaw_deg = 0.0\n[[vehicle]]\nname = \"first\"\n[[vehicle]]\n\
    name = \"second\"\nqueue = 128\n[vehicle.udp]\ninterface = \"eth1\"\n[[vehicle]]\nname = \"third\"\n\
    [vehicle.udp.from]\nrear = \"127.0.0.2\"\ntop = \"127.0.0.3\"\n[[vehicle.sensor]]\nname = \"rear\"\nextrinsics = { x_m = -1, y_m = 0, z_m = 1, roll_deg = 0, pitch_deg = 0, \
    yaw_deg = 180 }\n[[vehicle.sensor]]\nname = \"top\"\nextrinsics = { z_m = 2.5 }\n";

#[test]
fn vehicles_have_the_keys_of_the_defaults_that_they_do_not_have_themselves() {
    let config = parse(FLEET).unwrap();
    let [first, second, third] = &config.vehicles[..] else { panic!("{config:?}") };
    assert_eq!([first.queue, second.queue, third.queue], [64, 128, 64]);
    let [udp, of_second] = [first, second].map(|vehicle| vehicle.udp.clone().unwrap());
    assert_eq!((udp.data.port(), of_second.data.port(), &*of_second.interface), (0, 0, "eth1"));
    assert_eq!(first.sensors, second.sensors);
    let named: Vec<_> = third.sensors.iter().map(|sensor| (&*sensor.name, sensor.model.is_some())).collect();
    assert_eq!(named, [("rear", false), ("top", true)]);
    assert_eq!((third.sensors[1].extrinsics.z_m, first.sensors[0].extrinsics.z_m), (2.5, 1.9));
}

#[test]
fn wrong_defaults_are_named_with_their_line_and_the_vehicle() {
    for (of, wrong, said) in [
        ("queue = 64", "queue = \"many\"", ", line 2: vehicle.queue (of first) = \"many\": allowed: a whole number"),
        ("z_m = 1.9", "z = 1.9", ", line 12: vehicle.sensor[0].extrinsics.z (of first) is not a key"),
        ("queue = 64", "name = \"car\"", ", line 2: vehicle_defaults.name = \"car\": allowed: no name"),
        ("queue = 128", "queue = 3", ": vehicle.queue (of second) = 3: allowed: 16 to 1048576"),
    ] {
        let refused = error(&FLEET.replacen(of, wrong, 1));
        assert!(refused.starts_with(&format!("configuration clearway.toml{said}")), "{refused}");
    }
    let refused = error(&format!("vehicle_defaults = 1\n{NEEDED}"));
    assert!(refused.ends_with("line 1: vehicle_defaults = (no table): allowed: one table: write [vehicle_defaults]"));
}

#[test]
fn variables_and_options_override_keys_of_all_vehicles_or_of_one() {
    let variables = [
        ("CLEARWAY__VEHICLE_DEFAULTS__QUEUE", "32"),
        ("CLEARWAY__GRPC__LISTEN", "127.0.0.1:1"),
        ("CLEARWAY__PAGE__LISTEN", "127.0.0.1:2"),
        ("CLEARWAY_CONFIG", "a.toml"),
    ];
    let mut overrides = of_environment(variables.iter().map(|(name, value)| (name.to_string(), value.to_string())));
    let options = ["page.listen=127.0.0.1:3", "vehicle[third].queue=256", "vehicle[2].sensor[top].rpm=600"];
    overrides.extend(options.map(str::to_owned));
    let config = Config::parse(FLEET, Path::new("a.toml"), &overrides).unwrap();
    assert_eq!(config.vehicles.iter().map(|vehicle| vehicle.queue).collect::<Vec<_>>(), [32, 128, 256]);
    assert_eq!((config.grpc.listen.port(), config.page.listen.port()), (1, 3), "an option comes after a variable");
    let rpm: Vec<_> = config.vehicles[2].sensors.iter().map(|sensor| sensor.rpm).collect();
    assert_eq!(rpm, [None, Some(600.0)]);
    let refused = |text: &str| Config::parse(FLEET, Path::new("a.toml"), &[text.to_owned()]).unwrap_err().to_string();
    assert!(
        refused("vehicle[fourth].queue=1").starts_with("--set vehicle[fourth].queue=1: there is no vehicle[fourth];")
    );
    let start = "$CLEARWAY__GRPC__LISTE=1: grpc.liste is not a key; its table has: enabled, listen";
    assert!(refused("$CLEARWAY__GRPC__LISTE=1").starts_with(start), "{}", refused("$CLEARWAY__GRPC__LISTE=1"));
    let start = "--set vehicle_defaults.queue=3: vehicle.queue (of first) = 3: allowed: 16";
    assert!(refused("vehicle_defaults.queue=3").starts_with(start), "{}", refused("vehicle_defaults.queue=3"));
}

#[test]
fn one_file_has_vehicles_with_the_same_addresses_of_which_each_server_uses_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("fleet.toml");
    let defaults = "[vehicle_defaults.udp]\ndata = \"0.0.0.0:2368\"\n[vehicle_defaults.udp.from]\n\
        top = \"192.168.1.201\"\n[[vehicle_defaults.sensor]]\nname = \"top\"\n\
        [vehicle_defaults.sensor.extrinsics]\nx_m = 0.0\ny_m = 0.0\nz_m = 1.9\nroll_deg = 0.0\npitch_deg = 0.0\n\
        yaw_deg = 0.0\n";
    let vehicles = "[[vehicle]]\nname = \"car1\"\n[[vehicle]]\nname = \"car2\"\n[vehicle.maps]\nvalid_ms = 250\n";
    std::fs::write(&file, format!("{defaults}{vehicles}")).unwrap();
    let all = Config::load(&file, &[]).unwrap_err().to_string();
    assert!(all.contains("= 192.168.1.201: ") && all.contains("`--vehicle NAME` uses one vehicle"), "{all}");
    let (car2, none) = (["car2".to_owned()], Vec::new());
    let names = |config: &Config| config.vehicles.iter().map(|vehicle| vehicle.name.clone()).collect::<Vec<_>>();
    let config = Config::load_vehicles(&file, &none, &car2).unwrap();
    assert_eq!((names(&config), config.vehicles[0].maps.valid_ms), (car2.to_vec(), 250));
    // An override without a name means the first vehicle that is used.
    let config = Config::load_vehicles(&file, &["vehicle.maps.valid_ms=200".into()], &car2).unwrap();
    assert_eq!((names(&config), config.vehicles[0].maps.valid_ms), (car2.to_vec(), 200));
    let explained = Config::explain(&file, &none, &car2).unwrap();
    assert!(explained.contains("name = \"car2\"  # fleet.toml:17\n") && !explained.contains("car1"), "{explained}");
    let unknown = Config::load_vehicles(&file, &none, &["car3".into()]).unwrap_err().to_string();
    assert!(unknown.ends_with("there is no vehicle car3; its vehicles: car1, car2"), "{unknown}");
}
