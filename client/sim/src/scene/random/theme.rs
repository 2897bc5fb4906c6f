//! The themes of random worlds: what stands beside, across and over the road.
//!
//! In: random numbers and the ground. Out: kerbs and ditches as a profile across the road, and objects. The road runs
//! along x and the vehicle stands near the world's origin.

use std::f64::consts::PI;

use super::super::ground::Profile;
use super::super::world::World;
use super::barrier::{Opening, Style, barrier};
use super::draw::Draw;

/// What a random world shows, beside the form of its ground.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Theme {
    /// Kerbs that a vehicle climbs, or raised beds that it does not.
    Kerbs,
    /// A ditch or a bank along the road, mostly too steep to cross.
    Ditch,
    /// Bushes beside the road.
    Bushes,
    /// A fence, wall, rail or row of bollards whose openings are narrower than the vehicle.
    NarrowOpening,
    /// A fence, wall or rail with an opening that the vehicle passes.
    WideOpening,
    /// A fence, wall or rail without an opening.
    ClosedFence,
    /// Walls and buildings beside the road.
    Walls,
    /// Rows of parked cars.
    ParkedCars,
    /// Poles beside and on the road.
    Poles,
    /// A beam over the road under which the vehicle passes.
    HighOverhang,
    /// A beam over the road under which the vehicle does not pass.
    LowOverhang,
    /// Trees whose leaves hang over the road, high or low.
    Trees,
    /// Kerbs, parked cars, poles, trees and bushes together.
    Mixed,
}

impl Theme {
    /// All themes, in the order of the enum.
    pub const ALL: [Self; 13] = [
        Self::Kerbs,
        Self::Ditch,
        Self::Bushes,
        Self::NarrowOpening,
        Self::WideOpening,
        Self::ClosedFence,
        Self::Walls,
        Self::ParkedCars,
        Self::Poles,
        Self::HighOverhang,
        Self::LowOverhang,
        Self::Trees,
        Self::Mixed,
    ];

    /// Name of the theme, as `evaluate` prints it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Kerbs => "kerbs",
            Self::Ditch => "ditch",
            Self::Bushes => "bushes",
            Self::NarrowOpening => "narrow opening",
            Self::WideOpening => "wide opening",
            Self::ClosedFence => "closed fence",
            Self::Walls => "walls",
            Self::ParkedCars => "parked cars",
            Self::Poles => "poles",
            Self::HighOverhang => "high overhang",
            Self::LowOverhang => "low overhang",
            Self::Trees => "trees",
            Self::Mixed => "mixed",
        }
    }

    /// The kerbs or ditches of the theme, as heights across the road over the form's heights, and a description.
    pub(super) fn edges(self, draw: &mut Draw) -> (Profile, String) {
        match self {
            Self::Kerbs | Self::Mixed => kerbs(draw),
            Self::Ditch => ditch(draw),
            _ => (Profile::default(), String::new()),
        }
    }

    /// Adds the theme's objects, and describes them.
    pub(super) fn furnish(self, world: World, draw: &mut Draw) -> (World, String) {
        match self {
            Self::Kerbs | Self::Ditch => (world, String::new()),
            Self::Bushes => (bushes(world, draw, 24), "bushes".into()),
            Self::NarrowOpening => narrow_opening(world, draw),
            Self::WideOpening => {
                let width = draw.between(3.8, 6.0);
                enclosed(world, draw, &[width], Openings::OnBothSides)
            }
            Self::ClosedFence => enclosed(world, draw, &[], Openings::OnOneLine),
            Self::Walls => (walls(world, draw), "walls and buildings".into()),
            Self::ParkedCars => (parked_cars(world, draw), "rows of parked cars".into()),
            Self::Poles => (poles(world, draw, 16), "poles".into()),
            Self::HighOverhang => high_overhang(world, draw),
            Self::LowOverhang => low_overhang(world, draw),
            Self::Trees => trees(world, draw),
            Self::Mixed => {
                let world = bushes(poles(parked_cars(world, draw), draw, 6), draw, 6);
                let (world, text) = trees(world, draw);
                (world, format!("parked cars, poles, bushes, {text}"))
            }
        }
    }
}

/// Half the length of what runs along the road, and of what closes it, in metres: beyond the maps.
const FAR_M: f64 = 110.0;
/// Least width of an opening that is certainly narrower than the vehicle in the truth's raster, and the greatest, in
/// metres. The vehicle is 1.8 m wide, and the raster's cells of 0.2 m leave 0.4 m undecided.
const NARROW_M: (f64, f64) = (0.4, 1.35);

fn kerbs(draw: &mut Draw) -> (Profile, String) {
    let mut rises = [0.0; 2];
    let mut places = [0.0; 2];
    for side in 0..2 {
        places[side] = draw.between(3.0, 7.0);
        // Every third kerb is a raised bed that no vehicle climbs.
        rises[side] = if draw.chance(0.33) { draw.between(0.32, 0.6) } else { draw.between(0.08, 0.16) };
    }
    let [right, left] = places;
    let profile = Profile::through(&[(-right, rises[0]), (-right, 0.0), (left, 0.0), (left, rises[1])]);
    (profile, format!("kerbs {:.2} m right at {right:.1} m, {:.2} m left at {left:.1} m", rises[0], rises[1]))
}

fn ditch(draw: &mut Draw) -> (Profile, String) {
    let (side, near, floor) = (draw.sign(), draw.between(3.5, 8.0), draw.between(0.3, 1.2));
    let depth = draw.between(0.4, 1.1) * if draw.chance(0.3) { -1.0 } else { 1.0 };
    // A vehicle crosses slopes of up to 0.364.
    let slope = if draw.chance(0.25) { draw.between(0.10, 0.18) } else { draw.between(0.6, 1.6) };
    let run = depth.abs() / slope;
    let mut points = [(near, 0.0), (near + run, -depth), (near + run + floor, -depth), (near + 2.0 * run + floor, 0.0)]
        .map(|(place, height)| (side * place, height));
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let name = if depth > 0.0 { "ditch" } else { "bank" };
    (Profile::through(&points), format!("{name} {:.1} m, sides {slope:.2}, at y = {:.1} m", depth.abs(), side * near))
}

fn bushes(world: World, draw: &mut Draw, number: u32) -> World {
    (0..number).fold(world, |world, _| {
        let (x, y) = (draw.between(-40.0, 40.0), draw.sign() * draw.between(3.6, 12.0));
        world.bush(x, y, draw.between(0.4, 1.4), draw.between(0.5, 1.6))
    })
}

fn poles(world: World, draw: &mut Draw, number: u32) -> World {
    (0..number).fold(world, |world, _| {
        let (x, side) = (draw.sign() * draw.between(6.0, 40.0), draw.sign());
        let y = side * if draw.chance(0.3) { draw.between(0.0, 3.0) } else { draw.between(3.0, 12.0) };
        world.pole(x, y, draw.between(0.04, 0.2), draw.between(0.8, 7.0))
    })
}

fn parked_cars(mut world: World, draw: &mut Draw) -> World {
    for side in [-1.0, 1.0] {
        let (mut x, y) = (-45.0, side * draw.between(3.4, 6.5));
        loop {
            x += 4.6 + draw.between(0.4, 9.0);
            if x > 45.0 {
                break;
            }
            let heading = draw.between(-0.08, 0.08) + if draw.chance(0.5) { PI } else { 0.0 };
            world = world.parked_car(x, y, heading);
        }
    }
    world
}

fn walls(mut world: World, draw: &mut Draw) -> World {
    for side in [-1.0, 1.0] {
        let y = side * draw.between(4.0, 11.0);
        let mut x = -50.0;
        while x < 50.0 {
            let length = draw.between(5.0, 18.0);
            if draw.chance(0.5) {
                let line = [[x, y], [x + length, y + draw.between(-0.8, 0.8)]];
                world = barrier(world, Style::Wall(draw.between(0.6, 2.5)), line, &[]);
            } else {
                let (depth, height) = (draw.between(6.0, 12.0), draw.between(3.0, 9.0));
                let middle = [x + length / 2.0, y + side * depth / 2.0];
                world = world.building(middle[0], middle[1], 0.0, [length, depth], height);
            }
            x += length + draw.between(0.5, 12.0);
        }
    }
    world
}

fn trees(mut world: World, draw: &mut Draw) -> (World, String) {
    let low = draw.chance(0.4);
    let (least, most) = if low { (1.3, 2.2) } else { (2.9, 3.6) };
    for side in [-1.0, 1.0] {
        let mut x = -42.0;
        while x < 42.0 {
            x += draw.between(5.0, 14.0);
            let y = side * draw.between(4.2, 6.5);
            world = world.tree(x, y, draw.between(1.2, 3.2), draw.between(least, most));
        }
    }
    (world, format!("trees with {} leaves", if low { "low" } else { "high" }))
}

/// A beam across the road on two pillars, whose underside is `clearance` over the highest ground under it, or over the
/// lowest if the vehicle must not pass.
fn overhang(world: World, draw: &mut Draw, clearance: f64, passes: bool) -> (World, f64, f64) {
    let (x, half) = (draw.sign() * draw.between(8.0, 22.0), draw.between(4.0, 7.0));
    let middle = world.ground.height(x, 0.0);
    let heights = (-10..=10).map(|step| world.ground.height(x, half * f64::from(step) / 10.0) - middle);
    let (low, high) = heights.fold((0.0_f64, 0.0_f64), |(low, high), z| (low.min(z), high.max(z)));
    let underside = clearance + if passes { high } else { low };
    let top = underside + draw.between(0.4, 1.0);
    let world = world.beam([x, -half], [x, half], underside, top);
    let pillar = |world: World, y: f64| world.pole(x, y, 0.2, top + high - low);
    (pillar(pillar(world, -half), half), x, half)
}

fn high_overhang(world: World, draw: &mut Draw) -> (World, String) {
    let clearance = draw.between(2.8, 4.5);
    let (world, x, _) = overhang(world, draw, clearance, true);
    (world, format!("beam {clearance:.1} m over the road at x = {x:.0} m"))
}

fn low_overhang(world: World, draw: &mut Draw) -> (World, String) {
    let clearance = draw.between(1.2, 2.1);
    let (mut world, x, half) = overhang(world, draw, clearance, false);
    let mut text = format!("beam {clearance:.1} m over the road at x = {x:.0} m");
    // Beside the beam the ground is open, or closed by a fence.
    if draw.chance(0.5) {
        let style = Style::draw(draw);
        for side in [-1.0, 1.0] {
            world = barrier(world, style, [[x, side * half], [x, side * FAR_M]], &[]);
        }
        text += &format!(", {} beside it", style.text());
    }
    (world, text)
}

/// Where a barrier that runs along both sides of the road has its openings.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Openings {
    /// On one side.
    OnOneLine,
    /// On both sides, so that all ground is reached.
    OnBothSides,
}

/// Adds a barrier that closes a part of the world from the vehicle, with openings of these widths, and describes it.
fn enclosed(mut world: World, draw: &mut Draw, widths: &[f64], where_to: Openings) -> (World, String) {
    let style = Style::draw(draw);
    let (lines, layout) = match draw.whole(0, 2) {
        // Across the road, on one side of the vehicle.
        0 => {
            let (x, lean) = (draw.sign() * draw.between(9.0, 22.0), draw.between(-0.3, 0.3));
            (vec![[[x - lean * FAR_M, -FAR_M], [x + lean * FAR_M, FAR_M]]], format!("across at x = {x:.0} m"))
        }
        // Along both sides of the road.
        1 => {
            let [right, left] = [draw.between(3.6, 8.0), draw.between(3.6, 8.0)];
            let lines = [left, -right].map(|y| [[-FAR_M, y], [FAR_M, y]]);
            (lines.to_vec(), format!("on both sides at y = {left:.1}, -{right:.1} m"))
        }
        // Right round the vehicle.
        _ => {
            let (x, y) = (draw.between(10.0, 20.0), draw.between(7.0, 16.0));
            let corners = [[x, y], [-x, y], [-x, -y], [x, -y]];
            let lines = (0..4).map(|side| [corners[side], corners[(side + 1) % 4]]).collect();
            (lines, format!("round a yard of {:.0} by {:.0} m", 2.0 * x, 2.0 * y))
        }
    };
    // The openings are near the vehicle, so that the sensor sees through them.
    let line = draw.whole(0, lines.len() as u32 - 1) as usize;
    for (index, ends) in lines.iter().enumerate() {
        let length = (ends[1][0] - ends[0][0]).hypot(ends[1][1] - ends[0][1]);
        let reach = (length / 2.0 - 4.0).min(12.0);
        let first = length / 2.0 - reach;
        let pitch = 2.0 * reach / widths.len().max(1) as f64;
        let slack = (pitch - 5.0).max(0.0);
        let openings = widths.iter().enumerate().map(|(number, &width)| {
            let middle = first + pitch * (number as f64 + 0.5) + draw.between(-0.5, 0.5) * slack;
            (middle, width)
        });
        let has_openings = index == line || lines.len() == 2 && where_to == Openings::OnBothSides;
        let openings: Vec<Opening> = if has_openings { openings.collect() } else { Vec::new() };
        world = barrier(world, style, *ends, &openings);
    }
    let widths: Vec<String> = widths.iter().map(|width| format!(", opening of {width:.2} m")).collect();
    (world, format!("{} {layout}{}", style.text(), widths.concat()))
}

fn narrow_opening(mut world: World, draw: &mut Draw) -> (World, String) {
    if draw.chance(0.25) {
        // A row of bollards across the road, and fences on its sides.
        let (x, gap, radius) =
            (draw.sign() * draw.between(8.0, 15.0), draw.between(0.9, 1.3), draw.between(0.06, 0.15));
        let half = draw.between(3.5, 6.0);
        let pitch = gap + 2.0 * radius;
        let number = (2.0 * half / pitch).floor();
        for post in 0..=number as u32 {
            world = world.pole(x, -half + pitch * f64::from(post), radius, draw.between(0.9, 1.3));
        }
        let style = Style::draw(draw);
        let end = -half + pitch * number;
        world = barrier(world, style, [[x, end], [x, FAR_M]], &[]);
        world = barrier(world, style, [[x, -half], [x, -FAR_M]], &[]);
        return (world, format!("bollards {gap:.2} m apart at x = {x:.0} m, {} beside them", style.text()));
    }
    let widths: Vec<f64> = (0..draw.whole(1, 3)).map(|_| draw.between(NARROW_M.0, NARROW_M.1)).collect();
    enclosed(world, draw, &widths, Openings::OnOneLine)
}

/// Adds a few objects at random places away from the vehicle.
pub(super) fn scatter(mut world: World, draw: &mut Draw) -> World {
    for _ in 0..draw.whole(0, 6) {
        let (x, y) = (draw.sign() * draw.between(7.0, 45.0), draw.sign() * draw.between(4.5, 30.0));
        world = match draw.whole(0, 3) {
            0 => world.parked_car(x, y, draw.between(-PI, PI)),
            1 => world.pole(x, y, 0.1, 6.0),
            2 => world.bush(x, y, draw.between(0.4, 1.2), draw.between(0.5, 1.5)),
            _ => world.tree(x, y, draw.between(1.0, 2.4), draw.between(2.7, 3.3)),
        };
    }
    world
}
