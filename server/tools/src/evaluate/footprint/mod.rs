//! Whole footprints of a vehicle: what the truth says of them, and what a layer answers.
//!
//! In: points of known truth and an encoded map. Out: additions to a [`FootprintTally`]. The layers are asked as a
//! planner asks, through `clearway-client`: a footprint is free if every cell that it touches means free.
//!
//! | file | in -> out |
//! |---|---|
//! | [`ground`] | points -> the ground on which the truth lets a vehicle stand |
//! | [`tally`] | answers -> counts |
//! | [`gate`] | counts -> whether they pass a condition |

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

use anyhow::Result;
use clearway_client::{Answer, Footprint, MapView};

use super::judge::{JudgedPoint, OBSTACLE_M_MAX, Vote};

pub mod gate;
pub mod ground;
pub mod tally;

use ground::{FreeGround, KnownPlace, Surface, is_within, squares_within};
use tally::{BANDS_M, FootprintTally, HELD_M, WrongFootprint, band};

/// Length and width of a footprint, in metres: the README's rectangle.
const SIZE_M: [f32; 2] = [4.0, 2.0];
/// Number of footprints for each square metre of ground.
const DENSITY: f64 = 2.0;
/// Golden angle, as a share of a turn: footprints at its multiples cover all azimuths evenly.
const GOLDEN: f64 = 0.381_966_011_250_105_1;
/// Step of the headings, as a share of half a turn, without a common period with [`GOLDEN`].
const HEADING_STEP: f64 = 0.754_877_666_246_692_7;
/// Width at the edge of a footprint in which a place of the truth's raster does not count, in metres: the raster widens
/// objects by 0.14 m.
const RASTER_SLACK_M: f32 = 0.2;
/// Least height of vegetation that stands in a footprint, in metres. Labels of lower plants are unreliable.
const VEGETATION_M_MIN: f32 = 0.6;

/// A footprint and its truth.
#[derive(Clone, Debug, PartialEq)]
pub struct JudgedFootprint {
    /// The rectangle, ego frame.
    pub footprint: Footprint,
    /// Surface of the ground if the truth lets a vehicle stand there.
    pub free: Option<Surface>,
    /// Class and height of the highest thing in the rectangle, in metres.
    pub held: Option<(&'static str, f32)>,
    /// True if it covers ground that a vehicle cannot reach, and nothing stands in it.
    pub is_unreachable: bool,
}

/// The footprints of a frame whose truth is known. `sensor_m` is the position (x, y) of the sensor; `known` is what the
/// truth knows beside the points.
pub fn judged_footprints(points: &[JudgedPoint], known: &[KnownPlace], sensor_m: [f32; 2]) -> Vec<JudgedFootprint> {
    let ground = FreeGround::new(points, known, sensor_m);
    let things = things_by_square(points, known);
    footprints()
        .map(|footprint| {
            let (centre, heading_rad) = ([footprint.x_m as f32, footprint.y_m as f32], footprint.heading_rad as f32);
            let half = SIZE_M.map(|side| side / 2.0);
            let inside = things_about(&things, centre).filter(|thing| {
                let half = if thing.is_known { half.map(|half| half - RASTER_SLACK_M) } else { half };
                is_within(thing.place, centre, heading_rad, half)
            });
            let (mut held, mut is_unreachable) = (None::<(&'static str, f32)>, false);
            for thing in inside {
                match thing.height_m {
                    None => is_unreachable = true,
                    Some(height_m) if held.is_none_or(|(_, highest)| height_m > highest) => {
                        held = Some((thing.class, height_m));
                    }
                    Some(_) => {}
                }
            }
            let free = ground.surface(&squares_within(centre, heading_rad, half)).filter(|_| held.is_none());
            JudgedFootprint { footprint, free, held, is_unreachable: is_unreachable && held.is_none() }
        })
        .filter(|judged| judged.free.is_some() || judged.held.is_some() || judged.is_unreachable)
        .collect()
}

/// Adds what a layer of the map answers for each footprint.
///
/// # Errors
/// If the map does not have the layer.
pub fn judge_footprints(
    tally: &mut FootprintTally,
    map: &MapView,
    layer: &str,
    footprints: &[JudgedFootprint],
) -> Result<()> {
    for judged in footprints {
        let Footprint { x_m, y_m, heading_rad, .. } = judged.footprint;
        let Some(band) = band(x_m.hypot(y_m)) else { continue };
        let answer = map.answer(layer, &judged.footprint)?;
        let called_free = answer == Answer::Free;
        if let (Some(_), Answer::Low(blocker) | Answer::Blocked(blocker)) = (judged.free, answer) {
            *tally.refused.entry(blocker.class).or_default() += 1;
        }
        match judged.free {
            Some(Surface::Level) => tally.level[band].add(called_free),
            Some(Surface::Stepped) => tally.stepped[band].add(called_free),
            None => {}
        }
        if judged.is_unreachable {
            tally.unreachable[band].add(called_free);
        }
        let Some((class, height_m)) = judged.held else { continue };
        let Some(kind) = HELD_M.iter().rposition(|least| height_m >= *least) else { continue };
        tally.holding[kind][band].add(called_free);
        if called_free {
            tally.add_wrong(WrongFootprint { x_m, y_m, heading_deg: heading_rad.to_degrees(), class, height_m });
        }
    }
    Ok(())
}

/// Footprints at all ranges of the bands and at all azimuths and headings, evenly over the ground. Their places do not
/// depend on the frame.
fn footprints() -> impl Iterator<Item = Footprint> {
    let [near, far] = [BANDS_M[0], BANDS_M[BANDS_M.len() - 1]].map(|range_m| range_m * range_m);
    let number = (DENSITY * PI * (far - near)) as u32;
    (0..number).map(f64::from).map(move |index| {
        let range_m = (near + (index + 0.5) / f64::from(number) * (far - near)).sqrt();
        let (sin, cos) = (index * GOLDEN * TAU).sin_cos();
        Footprint {
            x_m: range_m * cos,
            y_m: range_m * sin,
            heading_rad: (index * HEADING_STEP).fract() * PI,
            length_m: SIZE_M[0].into(),
            width_m: SIZE_M[1].into(),
        }
    })
}

/// Something that must not be called free.
struct Thing {
    place: [f32; 2],
    class: &'static str,
    /// Height over the ground, in metres; `None` is ground that cannot be reached.
    height_m: Option<f32>,
    /// True if it is a place of the truth's raster and no point.
    is_known: bool,
}

/// Things by square of 1 m.
type Things = BTreeMap<(i32, i32), Vec<Thing>>;

fn things_by_square(points: &[JudgedPoint], known: &[KnownPlace]) -> Things {
    let of_point = |point: &JudgedPoint| {
        let least = if point.class == "vegetation" { VEGETATION_M_MIN } else { HELD_M[0] };
        let is_labelled = matches!(point.vote, Vote::Obstacle | Vote::Seen);
        let stands = is_labelled && point.over_m >= least && point.over_m <= OBSTACLE_M_MAX;
        let [x, y, _] = point.place;
        stands.then_some(Thing { place: [x, y], class: point.class, height_m: Some(point.over_m), is_known: false })
    };
    let of_place = |known: &KnownPlace| {
        let height_m = match known.vote {
            // The truth's raster has objects that are higher than a step, without their height.
            Vote::Obstacle => Some(HELD_M[2]),
            Vote::Forbidden => None,
            _ => return None,
        };
        Some(Thing { place: known.place, class: "object", height_m, is_known: true })
    };
    let mut things = Things::new();
    for thing in points.iter().filter_map(of_point).chain(known.iter().filter_map(of_place)) {
        things.entry((thing.place[0].floor() as i32, thing.place[1].floor() as i32)).or_default().push(thing);
    }
    things
}

fn things_about(things: &Things, [x, y]: [f32; 2]) -> impl Iterator<Item = &Thing> {
    let reach = (SIZE_M[0].hypot(SIZE_M[1]) / 2.0).ceil() as i32;
    let (i, j) = (x.floor() as i32, y.floor() as i32);
    (i - reach..=i + reach).flat_map(move |i| {
        let column = things.range((i, j - reach)..=(i, j + reach));
        column.flat_map(|(_, things)| things)
    })
}
