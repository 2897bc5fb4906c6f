//! The C++ client against the golden vectors, the golden questions and hostile bytes, beside the Rust client. Compiled
//! with warnings as errors and, where the compiler has them, with the sanitizers of addresses and undefined behaviour.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use clearway_client::{Answer, MapView};
use clearway_proto::codec::Limits;
use clearway_proto::grid::Grid;
use clearway_proto::map::{Layer, Map, decode_map, decode_map_on};
use clearway_proto::v1;
use prost::Message;
use rand::{Rng, SeedableRng};
use serde_json::{Value, json};

const REPOSITORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");
/// Greatest difference of numbers in two clients, in metres.
const SAME_M: f64 = 1e-9;
/// Seed of the damage to golden maps, and number of damaged copies of each.
const SEED: u64 = 37;
const DAMAGED: usize = 400;

/// Compiles a source file of `client/cpp`, and returns the program.
fn compiled(folder: &Path, source: &str) -> PathBuf {
    let program = folder.join("program");
    let compile = |options: &[&str]| {
        let mut compiler = Command::new("c++");
        compiler.args(["-std=c++17", "-Wall", "-Wextra", "-Werror", "-I", "client/cpp/include", "-o"]);
        compiler.arg(&program).arg(format!("client/cpp/{source}")).args(options).current_dir(REPOSITORY);
        compiler.output().expect("c++ runs")
    };
    let sanitized = compile(&["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-D_GLIBCXX_ASSERTIONS"]);
    if !sanitized.status.success() {
        let output = compile(&[]);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        eprintln!("compiled without sanitizers: {}", String::from_utf8_lossy(&sanitized.stderr));
    }
    program
}

/// The answers of the program to requests, in their order.
fn answers(program: &Path, requests: &[String]) -> Vec<Value> {
    let mut child = Command::new(program)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program runs");
    let mut input = child.stdin.take().expect("piped");
    let text = requests.join("\n");
    let writer = std::thread::spawn(move || input.write_all(text.as_bytes()));
    let output = child.wait_with_output().expect("the program ends");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    writer.join().expect("no panic").expect("the program reads all requests");
    let answers: Vec<Value> =
        String::from_utf8(output.stdout).unwrap().lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(answers.len(), requests.len());
    answers
}

fn file(path: &str) -> Vec<u8> {
    std::fs::read(Path::new(REPOSITORY).join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn golden(name: &str) -> Vec<Value> {
    serde_json::from_slice(&file(name)).unwrap()
}

fn hex(bytes: &[u8]) -> String {
    match bytes {
        [] => "-".into(),
        bytes => bytes.iter().map(|byte| format!("{byte:02x}")).collect(),
    }
}

fn unhex(digits: &str) -> Vec<u8> {
    (0..digits.len()).step_by(2).map(|at| u8::from_str_radix(&digits[at..at + 2], 16).unwrap()).collect()
}

/// Numbers and lists of numbers of a golden question, as words.
fn words(value: &Value) -> String {
    match value {
        Value::Array(items) => items.iter().map(words).collect::<Vec<_>>().join(" "),
        Value::String(text) => text.clone(),
        Value::Null => String::new(),
        number => number.to_string(),
    }
}

pub(super) fn is_same(one: &Value, other: &Value) -> bool {
    match (one, other) {
        (Value::Number(a), Value::Number(b)) => a == b || (a.as_f64().unwrap() - b.as_f64().unwrap()).abs() <= SAME_M,
        (Value::Array(one), Value::Array(other)) => {
            one.len() == other.len() && one.iter().zip(other).all(|(one, other)| is_same(one, other))
        }
        _ => one == other,
    }
}

/// Text as hexadecimal digits; empty for empty text.
pub(super) fn text(text: &str) -> String {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

/// A map as `client/cpp/tests/answers.cpp` shows it.
fn shown(map: &Map) -> Value {
    let header = &map.header;
    let pose = header.map_from_ego.map(|p| [p.x, p.y, p.z, p.qx, p.qy, p.qz, p.qw].map(f64::to_bits));
    let layers: Vec<_> = map.layers.iter().map(shown_layer).collect();
    json!([
        text(&header.vehicle),
        header.boot_id,
        header.sequence,
        header.epoch,
        header.capture_start_ns,
        header.capture_end_ns,
        header.completed_ns,
        header.valid_until_ns,
        pose,
        header.speed_mps.map(f64::to_bits),
        layers
    ])
}

fn shown_layer(layer: &Layer) -> Value {
    let grid = match &layer.grid {
        Grid::Radial { centre_m, row_radius_m, columns } => {
            let radii: Vec<_> = row_radius_m.iter().map(|radius| radius.to_bits()).collect();
            json!([radii, columns, centre_m[0].to_bits(), centre_m[1].to_bits()])
        }
        Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_ix, first_iy } => {
            let [x, y, yaw] = [origin_x_m, origin_y_m, yaw_rad].map(|value| value.to_bits());
            json!([x, y, width, height, cell_m.to_bits(), yaw, first_ix, first_iy])
        }
    };
    let legend: Vec<_> = layer.legend.iter().map(|c| json!([text(&c.name), c.meaning as i32, c.rgb])).collect();
    let channels = layer.channels.iter().map(|channel| {
        let cells: Vec<_> = (0..channel.cells.len()).map(|cell| channel.cells.get(cell)).collect();
        let cell_type = channel.cells.as_ref().cell_type() as i32;
        let (name, unit) = (text(&channel.name), text(&channel.unit));
        json!([name, unit, channel.scale.to_bits(), cell_type, channel.unknown, cells])
    });
    let planes: Vec<_> = layer.planes.iter().map(|plane| plane.map(f64::to_bits)).collect();
    let metrics: Vec<_> = layer.metrics.iter().map(|(name, value)| json!([text(name), value.to_bits()])).collect();
    let points = layer.points.iter();
    let points = points.map(|p| json!([p.x_m.to_bits(), p.y_m.to_bits(), p.radius_m.to_bits(), p.links]));
    let (channels, points): (Vec<_>, Vec<_>) = (channels.collect(), points.collect());
    json!([text(&layer.name), grid, legend, channels, planes, metrics, points])
}

/// Requests, and what each is to answer.
#[derive(Default)]
struct Cases {
    requests: Vec<String>,
    expected: Vec<Value>,
}

impl Cases {
    fn push(&mut self, request: String, expected: Value) {
        self.requests.push(request);
        self.expected.push(expected);
    }

    fn check(&self, program: &Path) {
        for ((request, expected), found) in
            self.requests.iter().zip(&self.expected).zip(answers(program, &self.requests))
        {
            assert!(is_same(&found, expected), "{request:.300}: {found:.300}, not {expected:.300}");
        }
    }
}

fn golden_cases() -> Cases {
    let mut cases = Cases::default();
    let error = |vector: &Value| json!({ "error": vector["error"] });
    let channel = |vector: &Value| {
        let number = |key: &str| vector[key].as_i64().unwrap();
        let claims = ["cell_type", "encoding", "cell_count", "columns", "crc32"].map(|key| number(key).to_string());
        format!("channel {} {}", claims.join(" "), vector["payload_hex"].as_str().unwrap())
    };
    for vector in golden("proto/golden/channels.json") {
        let spans = vector["cells_value_length"].as_array().unwrap().iter();
        let cells: Vec<_> =
            spans.flat_map(|span| std::iter::repeat_n(span[0].clone(), span[1].as_u64().unwrap() as usize)).collect();
        cases.push(channel(&vector), json!(cells));
    }
    for vector in golden("proto/golden/bad_channels.json") {
        cases.push(channel(&vector), error(&vector));
    }
    for vector in [golden("proto/golden/bad_maps.json"), golden("proto/golden/bad_deltas.json")].concat() {
        let base = vector["base_hex"].as_str().unwrap_or("-");
        cases.push(format!("map {base} {}", vector["map_hex"].as_str().unwrap()), error(&vector));
    }
    let base = file("proto/golden/delta_base.bin");
    let whole = |name: &str| {
        let bytes = file(&format!("proto/golden/{name}.bin"));
        shown(&decode_map(bytes.into(), &Limits::default()).unwrap())
    };
    for (base, name, equal) in [
        (&[][..], "map", "map"),
        (&[], "by_class", "by_class_plain"),
        (&[], "delta_whole", "delta_whole"),
        (&base, "delta", "delta_whole"),
    ] {
        let bytes = file(&format!("proto/golden/{name}.bin"));
        cases.push(format!("map {} {}", hex(base), hex(&bytes)), whole(equal));
    }
    cases
}

/// The golden questions, corners beyond any map, and the golden reasons of staleness.
fn questions() -> Cases {
    let mut cases = Cases::default();
    let golden_questions: Value = serde_json::from_slice(&file("client/golden/questions.json")).unwrap();
    let map = golden_questions["map"].as_str().unwrap();
    cases.push(format!("use {map}"), Value::Null);
    let questions = golden_questions["questions"].as_array().unwrap();
    assert!(questions.len() >= 1000, "{}", questions.len());
    for question in questions {
        let [ask, layer] = ["ask", "layer"].map(|key| question[key].as_str().unwrap());
        let of = |key: &str| words(&question[key]);
        let request = match ask {
            "answer" => format!("answer {layer} {}", of("polygon")),
            "along" if question["arc"].is_null() => format!("places {layer} {} {}", of("outline"), of("places")),
            "along" => format!("arc {layer} {} {}", of("outline"), of("arc")),
            "clearance" => format!("clearance {layer} {} {}", of("most_m"), i32::from(question["passes_low"] == true)),
            nearest => format!("{nearest} {layer} {} {}", of("point"), of("own")),
        };
        cases.push(request, question["answer"].clone());
    }
    let view = MapView::decode(unhex(map).into()).unwrap();
    for layer in ["turned", "squares", "rings"] {
        let polygon = [[1e18, 1e18], [2e18, 0.0], [0.0, 2e18]];
        let Ok(Answer::Blocked(blocker)) = view.answer(layer, &polygon) else { panic!("{layer} is not so large") };
        let place = json!([blocker.x_m, blocker.y_m, blocker.class, blocker.why]);
        cases.push(format!("answer {layer} {}", words(&json!(polygon))), json!(["blocked", place]));
    }
    let end_ns = 1_700_000_000_000_000_000;
    let valid = v1::Header { capture_end_ns: end_ns, valid_until_ns: end_ns + 300_000_000, ..Default::default() };
    let valid = v1::Map { header: Some(valid), layers: Vec::new() }.encode_to_vec();
    for case in golden("client/golden/staleness.json") {
        let [arrived, since] = ["age_on_arrival_ms", "since_arrival_ms"].map(|key| case[key].as_i64().unwrap());
        cases.push(format!("use {}", hex(&valid)), Value::Null);
        cases.push(format!("stale {} {}", arrived * 1_000_000, since * 1_000_000), case["stale_because"].clone());
    }
    cases
}

/// The addresses that every client accepts and refuses.
fn check_addresses(program: &Path) {
    let cases = golden("client/golden/addresses.json");
    let request = |case: &Value| {
        format!("address {} {}", u8::from(case["certificates"] == true), case["address"].as_str().unwrap())
    };
    let requests: Vec<_> = cases.iter().map(request).collect();
    for (case, found) in cases.iter().zip(answers(program, &requests)) {
        assert_eq!(found, text(case["refused"].as_str().unwrap_or_default()), "{case}");
    }
}

/// Corners whose differences are infinite are never free, whichever cell is named.
fn check_overflow(program: &Path) {
    let map: Value = serde_json::from_slice(&file("client/golden/questions.json")).unwrap();
    let mut requests = vec![format!("use {}", map["map"].as_str().unwrap())];
    for layer in ["turned", "squares", "rings"] {
        requests.push(format!("answer {layer} 1e300 1e300 1e308 0 0 1e308"));
        requests.push(format!("answer {layer} -1.7e308 -1.7e308 1.7e308 0 0 1.7e308"));
    }
    for (request, found) in requests.iter().zip(answers(program, &requests)).skip(1) {
        assert_eq!(found[0], "blocked", "{request}: {found}");
    }
}

/// The corpora of the fuzz targets, and golden maps with damage. The Rust client decides what they are.
fn check_hostile(program: &Path) {
    let base = file("proto/golden/delta_base.bin");
    let mut inputs: Vec<(&[u8], Vec<u8>)> = Vec::new();
    for (base, corpus) in [(&[][..], "decode_map"), (&base, "decode_delta")] {
        let folder = Path::new(REPOSITORY).join("proto/fuzz/corpus").join(corpus);
        let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        files.sort();
        inputs.extend(files.into_iter().map(|path| (base, std::fs::read(path).unwrap())));
    }
    assert!(inputs.len() > 50, "{}", inputs.len());
    println!("seed {SEED}");
    let mut random = rand_pcg::Pcg64::seed_from_u64(SEED);
    for (base, name) in [(&[][..], "map"), (&[], "by_class"), (&[], "delta_whole"), (&base, "delta")] {
        let sound = file(&format!("proto/golden/{name}.bin"));
        for _ in 0..DAMAGED {
            let mut damaged = sound.clone();
            for _ in 0..random.random_range(1..3) {
                let at = random.random_range(0..damaged.len());
                match random.random_range(0..12) {
                    0 => damaged.truncate(at.max(1)),
                    1 => damaged.insert(at, random.random()),
                    _ => damaged[at] = random.random(),
                }
            }
            inputs.push((base, damaged));
        }
    }
    let requests: Vec<_> = inputs.iter().map(|(base, map)| format!("map {} {}", hex(base), hex(map))).collect();
    let base_map = decode_map(base.clone().into(), &Limits::default()).unwrap();
    let (mut decoded, mut refused) = (0, 0);
    for ((base, map), found) in inputs.iter().zip(answers(program, &requests)) {
        let base = (!base.is_empty()).then_some(&base_map);
        match decode_map_on(map.clone().into(), base, &Limits::default()) {
            Ok(expected) => {
                assert_eq!(found, shown(&expected), "{}", hex(map));
                decoded += 1;
            }
            // Fields that the C++ client does not read, and payloads that are not canonical, are faults in Rust alone.
            Err(error) if found.is_array() => assert!(["protobuf", "cells"].contains(&error.name()), "{error}"),
            Err(_) => refused += 1,
        }
    }
    println!("{} hostile inputs: {decoded} decoded alike, {refused} refused by both", inputs.len());
    assert!(decoded > 50 && refused > 1000, "{decoded} decoded, {refused} refused");
}

#[test]
#[cfg_attr(not(clearway_cpp), ignore = "needs a C++ compiler: apt-get install g++")]
fn the_cpp_client_decodes_and_answers_as_the_rust_client() {
    let folder = tempfile::tempdir().unwrap();
    let program = compiled(folder.path(), "tests/answers.cpp");
    golden_cases().check(&program);
    questions().check(&program);
    check_addresses(&program);
    check_overflow(&program);
    check_hostile(&program);
    let header = String::from_utf8(file("client/cpp/include/clearway/wire.hpp")).unwrap();
    let limits: serde_json::Map<_, _> = serde_json::from_slice(&file("proto/golden/limits.json")).unwrap();
    for (name, value) in limits {
        let line = header.lines().find(|line| line.contains(&format!(" {} = ", name.to_uppercase()))).expect(&name);
        let stated = line.split(" = ").nth(1).unwrap().trim_end_matches(';').replace('u', "");
        let (number, shift) = stated.split_once(" << ").unwrap_or((&stated, "0"));
        let number = match number.strip_prefix("0x") {
            Some(digits) => u64::from_str_radix(digits, 16).unwrap(),
            None => number.parse().unwrap(),
        };
        assert_eq!(number << shift.parse::<u32>().unwrap(), value.as_u64().unwrap(), "{line}");
    }
}

#[test]
#[cfg_attr(not(clearway_cpp), ignore = "needs a C++ compiler: apt-get install g++")]
fn the_cpp_example_answers_about_a_fresh_map_and_refuses_a_stale_one() {
    let folder = tempfile::tempdir().unwrap();
    let program = compiled(folder.path(), "examples/is_free.cpp");
    let golden_questions: Value = serde_json::from_slice(&file("client/golden/questions.json")).unwrap();
    let mut map = v1::Map::decode(&unhex(golden_questions["map"].as_str().unwrap())[..]).unwrap();
    map.layers.iter_mut().find(|layer| layer.name == "squares").unwrap().name = "freespace".into();
    let end_ns = clearway_client::now_ns();
    let said = |header: v1::Header| {
        let path = folder.path().join("map.bin");
        let map = v1::Map { header: Some(header), ..map.clone() };
        std::fs::write(&path, map.encode_to_vec()).unwrap();
        String::from_utf8(Command::new(&program).arg(path).output().unwrap().stdout).unwrap()
    };
    let valid = v1::Header {
        vehicle: "car".into(),
        sequence: 7,
        capture_end_ns: end_ns,
        valid_until_ns: end_ns + 60_000_000_000,
        ..Default::default()
    };
    let fresh = said(valid.clone());
    assert!(fresh.starts_with("map 7 of car\nhere: "), "{fresh}");
    assert!(fresh.contains("\nahead: blocked after 0 m by unknown at "), "{fresh}");
    let stale = said(v1::Header { valid_until_ns: end_ns, capture_end_ns: end_ns - 1, ..valid });
    assert!(stale.starts_with("STALE: it was ") && stale.contains(" old when it arrived"), "{stale}");
}
