//! Questions of a planner and their answers, in `client/golden/questions.json`: the same for every client.
//!
//! `CLEARWAY_BLESS=1 cargo test --workspace --test client questions` writes the file again, from [`SEED`].

use std::path::Path as FilePath;

use bytes::Bytes;
use clearway_client::codec::{CellsRef, encode_grid};
use clearway_client::v1::layer::Geometry;
use clearway_client::{Answer, Area, Blocker, ClientError, Footprint, MapView, Outline, Path, v1};
use clearway_proto::legend::encode_legend;
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::v1::ClassMeaning;
use serde_json::{Value, json};

/// Seed of the questions.
const SEED: u64 = 34;
/// Number of questions of each kind about each layer.
const QUESTIONS: usize = 54;
/// Greatest difference of numbers in two clients, in metres.
const SAME_M: f64 = 1e-9;

const LEGEND: [(&str, ClassMeaning, u32); 6] = [
    ("unknown", ClassMeaning::Unknown, 0),
    ("free", ClassMeaning::Free, 1),
    ("vehicle", ClassMeaning::Free, 2),
    ("occupied", ClassMeaning::Occupied, 3),
    ("low", ClassMeaning::Low, 4),
    ("hidden", ClassMeaning::Hidden, 5),
];

/// Numbers that depend on nothing but the seed (xorshift64*).
struct Numbers(u64);

impl Numbers {
    fn unit(&mut self) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// A number to three digits, so that the file shows all of it.
    fn between(&mut self, low: f64, high: f64) -> f64 {
        ((low + self.unit() * (high - low)) * 1e3).round() / 1e3
    }

    fn point(&mut self, reach: f64) -> [f64; 2] {
        [self.between(-reach, reach), self.between(-reach, reach)]
    }
}

/// Classes of a grid: free, with some blots of the other classes.
fn blots(numbers: &mut Numbers, rows: usize, columns: usize) -> Vec<u8> {
    let mut classes = vec![1; rows * columns];
    for _ in 0..10 {
        let class = (numbers.unit() * 6.0) as u8;
        let (row, column) = (numbers.unit() * rows as f64, numbers.unit() * columns as f64);
        for (index, cell) in classes.iter_mut().enumerate() {
            let off = (index / columns) as f64 - row;
            if off.hypot((index % columns) as f64 - column) < 1.3 {
                *cell = class;
            }
        }
    }
    classes
}

/// A map with the layers `turned` (squares, seen from a turned vehicle), `squares` and `rings`.
fn map(numbers: &mut Numbers) -> Bytes {
    let squares = |yaw_rad| {
        let (origin_x_m, origin_y_m, width, height, cell_m) = (-4.0, -3.0, 32, 24, 0.25);
        Geometry::Cartesian(v1::CartesianGrid {
            origin_x_m,
            origin_y_m,
            width,
            height,
            cell_m,
            yaw_rad,
            ..Default::default()
        })
    };
    let row_radius_m: Vec<f32> = (1..=10).map(|row| row as f32 * 0.5).collect();
    let rings = v1::RadialGrid { row_radius_m, columns: 36, centre_x_m: 0.3, centre_y_m: -0.2 };
    let layers = [
        ("turned", squares(0.4), 24, 32),
        ("squares", squares(0.0), 24, 32),
        ("rings", Geometry::Radial(rings), 10, 36),
    ];
    let mut drawn = Numbers(SEED + 1);
    let mut encoded = encode_header(&v1::Header::default()).to_vec();
    for (name, geometry, rows, columns) in layers {
        let classes = blots(numbers, rows, columns);
        // Reasons; the clients do not know the last one.
        let reasons: Vec<u8> = (0..classes.len()).map(|_| (drawn.unit() * 10.0) as u8).collect();
        let channel =
            |name: &str, cells: &[u8]| encode_grid(CellsRef::U8(cells), columns).into_channel(name, "", 1.0, 0);
        let why = (name == "squares").then(|| channel("why", &reasons));
        let mut layer = v1::Layer {
            name: name.into(),
            geometry: Some(geometry),
            channels: [channel("class", &classes)].into_iter().chain(why).collect(),
            ..Default::default()
        };
        encode_legend(&mut layer, LEGEND);
        encoded.extend_from_slice(&encode_layer(&layer));
    }
    encoded.into()
}

/// The questions: each an object with the layer, the kind and the shape.
fn questions(numbers: &mut Numbers) -> Vec<Value> {
    let mut asked = Vec::new();
    for layer in ["turned", "squares", "rings"] {
        for _ in 0..QUESTIONS {
            let ([x_m, y_m], heading_rad) = (numbers.point(3.0), numbers.between(-3.2, 3.2));
            let (length_m, width_m) = (numbers.between(0.0, 2.0), numbers.between(0.0, 1.0));
            let rectangle = Footprint { x_m, y_m, heading_rad, length_m, width_m }.corners();
            asked.push(json!({ "ask": "answer", "layer": layer, "polygon": rectangle }));
            let star: Vec<[f64; 2]> = (0..7)
                .map(|corner| {
                    let (sin, cos) = (f64::from(corner) / 7.0 * std::f64::consts::TAU).sin_cos();
                    let range_m = numbers.between(0.05, 1.0);
                    [x_m + range_m * cos, y_m + range_m * sin]
                })
                .collect();
            asked.push(json!({ "ask": "answer", "layer": layer, "polygon": star }));
            let outline = [numbers.between(0.0, 0.6), numbers.between(0.0, 0.4), numbers.between(0.0, 0.5)];
            let arc = [numbers.between(-0.5, 0.5), numbers.between(-3.0, 4.0)];
            asked.push(json!({ "ask": "along", "layer": layer, "arc": arc, "outline": outline }));
            let places = [[0.0, 0.0], numbers.point(2.0), numbers.point(3.0)];
            asked.push(json!({ "ask": "along", "layer": layer, "places": places, "outline": outline }));
            let own = if numbers.unit() < 0.5 { json!([2.0, 1.0, 1.5]) } else { Value::Null };
            let point = numbers.point(4.0);
            asked.push(json!({ "ask": "nearest_obstacle", "layer": layer, "point": point, "own": own }));
            asked.push(json!({ "ask": "nearest_low", "layer": layer, "point": point, "own": own }));
        }
        // On borders of cells, over the grid's border, far outside, and a ring whose last corner is its first.
        for polygon in [
            json!([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]]),
            json!([[3.0, 2.0], [9.0, 2.0], [9.0, 3.0]]),
            json!([[1e9, 1e9], [1e9, 2e9], [2e9, 2e9]]),
            json!([[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]),
            json!([[0.1, 0.1], [0.4, 0.1], [0.4, 0.4], [0.1, 0.1]]),
        ] {
            asked.push(json!({ "ask": "answer", "layer": layer, "polygon": polygon }));
        }
        for (most_m, passes_low) in [(10.0, false), (0.6, true), (0.0, false)] {
            asked.push(json!({ "ask": "clearance", "layer": layer, "most_m": most_m, "passes_low": passes_low }));
        }
    }
    for polygon in [
        json!([[0, 0], [1, "NaN"], [1, 1]]),
        json!([["inf", 0], [1, 0], [1, 1]]),
        json!([[0, 0], [1, 0]]),
        json!([[0, 0], [0, 0], [1, 0], [0, 0]]),
        json!([[0, 0], [1, 1], [1, 0], [0, 1]]),
        json!([[0, 0], [4, 0], [1, 3], [2, -1], [3, 3]]),
    ] {
        asked.push(json!({ "ask": "answer", "layer": "squares", "polygon": polygon }));
    }
    for (arc, outline) in [
        (json!(["NaN", 1]), json!([1, 1, 1])),
        (json!([0, "-inf"]), json!([1, 1, 1])),
        (json!([0, 1001]), json!([1, 1, 1])),
        (json!([0, 1]), json!([1, -0.1, 1])),
        (json!([0, 1]), json!([1, 1, "NaN"])),
    ] {
        asked.push(json!({ "ask": "along", "layer": "squares", "arc": arc, "outline": outline }));
    }
    asked.push(json!({ "ask": "along", "layer": "squares", "places": [[1, 1], [1, 1]], "outline": [1, 1, 1] }));
    // Turns that move a corner much farther than the reference point.
    for layer in ["squares", "rings"] {
        for _ in 0..30 {
            let (front, rear, width) =
                (numbers.between(0.2, 2.0), numbers.between(0.0, 0.5), numbers.between(0.1, 0.5));
            let arc = [numbers.between(-20.0, 20.0), numbers.between(-0.5, 0.5)];
            asked.push(json!({ "ask": "along", "layer": layer, "arc": arc, "outline": [front, rear, width] }));
            let [from, by] = [numbers.point(1.5), numbers.point(1.5)];
            let places = [from, by, numbers.point(1.5), by];
            asked.push(json!({ "ask": "along", "layer": layer, "places": places, "outline": [front, rear, width] }));
        }
    }
    asked.push(json!({ "ask": "nearest_obstacle", "layer": "squares", "point": [0, "NaN"], "own": null }));
    asked.push(json!({ "ask": "nearest_low", "layer": "squares", "point": [0, 0], "own": [1, "inf", 1] }));
    asked.push(json!({ "ask": "clearance", "layer": "squares", "most_m": -1, "passes_low": false }));
    asked
}

/// A number of the file; JSON has none that are not finite.
fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| value.as_str().and_then(|text| text.parse().ok()).expect("a number"))
}

fn points(value: &Value) -> Vec<[f64; 2]> {
    value.as_array().expect("points").iter().map(|point| [number(&point[0]), number(&point[1])]).collect()
}

fn outline(value: &Value) -> Option<Outline> {
    let at = |index: usize| number(&value[index]);
    (!value.is_null()).then(|| Outline { front_m: at(0), rear_m: at(1), width_m: at(2) })
}

/// The answer of this client, or the kind of its error.
fn answer(map: &MapView, question: &Value) -> Value {
    let (layer, own) = (question["layer"].as_str().expect("a layer"), outline(&question["own"]));
    let place = |blocker: &Blocker| json!([blocker.x_m, blocker.y_m, blocker.class, blocker.why]);
    let point = || [number(&question["point"][0]), number(&question["point"][1])];
    let answered = match question["ask"].as_str().expect("a kind") {
        "answer" => map.answer(layer, &points(&question["polygon"])).map(|answer| match answer {
            Answer::Free => json!(["free", null]),
            Answer::Low(blocker) => json!(["low", place(&blocker)]),
            Answer::Blocked(blocker) => json!(["blocked", place(&blocker)]),
        }),
        "along" => {
            let arc = &question["arc"];
            let path = match arc {
                Value::Null => Path::Places(points(&question["places"])),
                arc => Path::Arc { curvature_per_m: number(&arc[0]), length_m: number(&arc[1]) },
            };
            map.along(layer, &path, &outline(&question["outline"]).expect("an outline")).map(|met| {
                let [low, blocked] =
                    [met.low, met.blocked].map(|met| met.map(|(along_m, blocker)| json!([along_m, place(&blocker)])));
                json!([met.length_m, low, blocked])
            })
        }
        "clearance" => {
            let passes_low = question["passes_low"] == true;
            map.clearance(layer, number(&question["most_m"]), passes_low).map(|clearance| json!(clearance.cells_m))
        }
        kind => {
            let nearest = match kind {
                "nearest_obstacle" => map.nearest_obstacle(layer, point(), own.as_ref()),
                _ => map.nearest_low(layer, point(), own.as_ref()),
            };
            let place = |met: clearway_client::Obstacle| json!([met.x_m, met.y_m, met.distance_m, met.class]);
            nearest.map(|nearest| nearest.map_or(Value::Null, place))
        }
    };
    answered.unwrap_or_else(|error| match error {
        ClientError::Shape(error) => json!({ "error": error.kind() }),
        ClientError::NoSquares { .. } => json!({ "error": "no_squares" }),
        error => panic!("{question}: {error}"),
    })
}

fn is_same(one: &Value, other: &Value) -> bool {
    match (one, other) {
        (Value::Number(_), Value::Number(_)) => (number(one) - number(other)).abs() <= SAME_M,
        (Value::Array(one), Value::Array(other)) => {
            one.len() == other.len() && one.iter().zip(other).all(|(one, other)| is_same(one, other))
        }
        _ => one == other,
    }
}

#[test]
fn the_golden_questions_have_the_golden_answers() {
    let file = FilePath::new(env!("CARGO_MANIFEST_DIR")).join("golden/questions.json");
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        let mut numbers = Numbers(SEED);
        let encoded = map(&mut numbers);
        let view = MapView::decode(encoded.clone()).unwrap();
        let lines: Vec<String> = questions(&mut numbers)
            .into_iter()
            .map(|mut question| {
                question["answer"] = answer(&view, &question);
                format!("    {question}")
            })
            .collect();
        let hex: String = encoded.iter().map(|byte| format!("{byte:02x}")).collect();
        let text = format!("{{\n  \"map\": \"{hex}\",\n  \"questions\": [\n{}\n  ]\n}}\n", lines.join(",\n"));
        std::fs::write(&file, text).unwrap();
    }
    let golden: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let hex = golden["map"].as_str().unwrap();
    let byte = |index: usize| u8::from_str_radix(&hex[index..index + 2], 16).unwrap();
    let view = MapView::decode((0..hex.len()).step_by(2).map(byte).collect()).unwrap();
    let questions = golden["questions"].as_array().unwrap();
    assert!(questions.len() >= 1000, "{}", questions.len());
    let kinds = |wanted: &str| questions.iter().filter(|question| question["answer"][0] == wanted).count();
    assert!(["free", "low", "blocked"].map(kinds).iter().all(|count| *count > 20), "every answer occurs");
    for question in questions {
        let found = answer(&view, question);
        assert!(is_same(&found, &question["answer"]), "{question}: {found}");
    }
}

/// A map of free squares of 0.25 m and one occupied one, with its centre at a place.
fn free_but_at([x_m, y_m]: [f64; 2]) -> MapView {
    let (origin_x_m, origin_y_m, width, height, cell_m) = (-8.0, -8.0, 64, 64, 0.25);
    let mut cells = [1_u8; 4096];
    cells[((y_m + 8.0) / 0.25) as usize * 64 + ((x_m + 8.0) / 0.25) as usize] = 3;
    let grid = v1::CartesianGrid { origin_x_m, origin_y_m, width, height, cell_m, ..Default::default() };
    let mut layer = v1::Layer {
        name: "squares".into(),
        geometry: Some(Geometry::Cartesian(grid)),
        channels: vec![encode_grid(CellsRef::U8(&cells), 64).into_channel("class", "", 1.0, 0)],
        ..Default::default()
    };
    encode_legend(&mut layer, LEGEND);
    let mut encoded = encode_header(&v1::Header::default()).to_vec();
    encoded.extend_from_slice(&encode_layer(&layer));
    MapView::decode(encoded.into()).unwrap()
}

#[test]
fn a_vehicle_that_turns_meets_every_cell_over_which_its_front_sweeps() {
    let outline = Outline { front_m: 3.0, rear_m: 0.5, width_m: 0.5 };
    let meets = |path: &Path, heading_rad: f64, place: [f64; 2]| {
        let (sin, cos) = heading_rad.sin_cos();
        let front = [place[0] + 2.99 * cos, place[1] + 2.99 * sin];
        let met = free_but_at(front).along("squares", path, &outline).unwrap();
        assert!(met.blocked.is_some(), "{path:?}: nothing at {front:?}, heading {heading_rad}");
    };
    for radius_m in [2.0, 0.5, 0.2, 0.1, 0.05] {
        let path = Path::Arc { curvature_per_m: 1.0 / radius_m, length_m: radius_m * std::f64::consts::PI };
        for degrees in 0..=180 {
            let heading_rad = f64::from(degrees).to_radians();
            meets(&path, heading_rad, [radius_m * heading_rad.sin(), radius_m * (1.0 - heading_rad.cos())]);
        }
    }
    let back = Path::Places(vec![[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]);
    (0..=180).for_each(|degrees| meets(&back, f64::from(degrees).to_radians(), [1.0, 0.0]));
    let right = Path::Places(vec![[0.0, 0.0], [1.0, 0.0], [1.0, -1.0]]);
    (0..=90).for_each(|degrees| meets(&right, -f64::from(degrees).to_radians(), [1.0, 0.0]));
    for (path, value) in [
        (Path::Arc { curvature_per_m: 1e308, length_m: 20.0 }, "inf"),
        (Path::Arc { curvature_per_m: 1e3, length_m: 20.0 }, "60207."),
    ] {
        let error = free_but_at([0.0, 0.0]).along("squares", &path, &outline).unwrap_err().to_string();
        assert!(error.starts_with(&format!("the turn of the farthest corner is {value}")), "{path:?}: {error}");
    }
}

#[test]
fn the_error_of_a_shape_names_the_value_and_what_is_needed() {
    let said = |error: clearway_client::ShapeError| error.to_string();
    let polygon = |corners: &[[f64; 2]]| said(corners.checked_corners().unwrap_err());
    assert_eq!(polygon(&[[0.0, 0.0], [1.0, f64::NAN], [1.0, 1.0]]), "corner 1, y is NaN; a finite number is needed");
    assert!(polygon(&[[0.0, 0.0], [1.0, 0.0]]).starts_with("polygon has 2 different places; 3 to 1000"));
    let crossed = polygon(&[[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]);
    assert!(crossed.starts_with("edges 0 and 2 of the polygon cross near (0.500, 0.500) m"), "{crossed}");
    let car = Footprint { x_m: 0.0, y_m: 0.0, heading_rad: 0.0, length_m: -4.0, width_m: 2.0 };
    assert_eq!(said(car.checked_corners().unwrap_err()), "length_m is -4 m; 0 or more m is allowed");
}
