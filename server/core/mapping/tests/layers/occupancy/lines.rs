//! The variant `paper` (Seo 2014, algorithm 1), and the hits as the paper publishes them.

use clearway_mapping::config::{Hits, OccupancyVariant};

use super::*;

fn paper() -> OccupancyConfig {
    OccupancyConfig { variant: OccupancyVariant::Paper, ..OccupancyConfig::default() }
}

#[test]
fn a_line_through_each_return_clears_before_it_and_hides_behind_it() {
    let sweep = wall();
    let mut occupancy = Occupancy::new(&paper());
    occupancy.integrate(&rays(&sweep));
    let layer = made(&mut occupancy, None);
    for (x, y, expected) in [
        (5.0, 0.1, CLEAR),
        (9.6, 4.0, CLEAR),
        (10.1, 0.1, OCCUPIED),
        (10.1, -3.1, OCCUPIED),
        (12.0, 0.1, OCCLUDED),
        (45.0, -40.0, OCCLUDED),
        // No return, no line: other than in the variant `polar`, nothing states how far the sensor looks.
        (-5.0, 0.1, UNKNOWN),
        (5.0, 30.0, UNKNOWN),
    ] {
        assert_eq!(class_at(&layer, x, y), expected, "({x}, {y})");
    }
    let near = OccupancyConfig { range_m_max: 20.0, ..paper() };
    let mut occupancy = Occupancy::new(&near);
    occupancy.integrate(&rays(&sweep));
    let layer = made(&mut occupancy, None);
    assert_eq!([19.0, 21.0].map(|x| class_at(&layer, x, 0.1)), [OCCLUDED, OUT_OF_RANGE]);
}

#[test]
fn lines_stay_in_the_world_while_the_vehicle_moves() {
    let sweep = wall();
    let (start, later) = (pose(0.0, 0.0, 0.0), pose(1.3, -2.6, 0.0));
    let mut occupancy = Occupancy::new(&paper());
    occupancy.integrate(&Rays { map_from_ego: Some(start), ..rays(&sweep) });
    let layer = made(&mut occupancy, Some(later));
    let at = |x: f32, y: f32| class_at(&layer, x - 1.3, y + 2.6);
    assert_eq!([at(5.1, 0.1), at(10.1, 0.1), at(12.1, 0.1)], [CLEAR, OCCUPIED, OCCLUDED]);
    // An empty scan is no evidence, and a scan counts in one map.
    occupancy.integrate(&Rays { map_from_ego: Some(later), ..rays(&Sweep::default()) });
    let after = made(&mut occupancy, Some(later));
    assert!(classes(&after).iter().all(|class| *class != CLEAR && *class != OCCLUDED));
}

#[test]
fn counted_hits_are_the_numbers_of_returns_and_reduced_hits_their_powers_of_two() {
    let mut sweep = Sweep { mount_height_m: 0.45, ..Sweep::default() };
    for (x, returns) in [(10.1, 19), (12.1, 3), (14.1, 20)] {
        for _ in 0..returns {
            add(&mut sweep, [x, 0.3 * x, 0.6]);
        }
    }
    let hits = |hits: Hits, x: f32| {
        let mut occupancy = Occupancy::new(&OccupancyConfig { hits, ..OccupancyConfig::default() });
        let map_from_ego = Some(pose(0.0, 0.0, 0.0));
        occupancy.integrate(&Rays { map_from_ego, speed_mps: Some(0.0), ..rays(&sweep) });
        let layer = made(&mut occupancy, map_from_ego);
        values(&layer, "hits")[cell_at(&layer, x, 0.3 * x).unwrap()]
    };
    assert_eq!([10.1, 12.1, 14.1, 16.1].map(|x| hits(Hits::Counted, x)), [19, 3, 255, 0]);
    // The first two posts are occluded: a ray ends in the cell of its return.
    assert_eq!([10.1, 12.1, 14.1, 16.1].map(|x| hits(Hits::Reduced, x)), [0, 0, 255, 0]);
    let level = |state, hits| {
        let cell = Cell { state, hits, age: 0 };
        [Hits::Reduced, Hits::Counted].map(|published| cell.level(published))
    };
    assert_eq!(level(OccupancyClass::Unknown, 19), [16, 19]);
    assert_eq!(level(OccupancyClass::Occluded, 19), [0, 19]);
    assert_eq!(level(OccupancyClass::Unknown, u8::MAX), [128, 254]);
    assert_eq!(level(OccupancyClass::Occupied, u8::MAX), [255, 255]);
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn lines_of_a_roof_sensor_clear_ground_that_hides_obstacles() {
    let (sweep, labels) = labels::labelled_frame();
    let shared = shared(&sweep);
    let mut shares = [[0.0; 3]; 2];
    for (shares, config) in shares.iter_mut().zip([OccupancyConfig::default(), paper()]) {
        let mut occupancy = Occupancy::new(&config);
        // The paper's heights are those over the plane under the vehicle.
        let is_paper = config.variant == OccupancyVariant::Paper;
        let heights_m = if is_paper { &sweep.z } else { shared.context().heights_m(&sweep) };
        occupancy.integrate(&Rays { heights_m, ..rays(&sweep) });
        let layer = made(&mut occupancy, None);
        let cells = classes(&layer).len();
        let truth = labels::truth_by_cell(&sweep, &labels, cells, |x, y| cell_at(&layer, x, y));
        let clear: Vec<bool> = classes(&layer).iter().map(|class| *class == CLEAR).collect();
        *shares = [
            labels::share(&clear, |cell| !truth.obstacle[cell]),
            labels::share(&truth.road, |cell| clear[cell]),
            labels::share(&truth.obstacle, |cell| classes(&layer)[cell] == OCCUPIED),
        ];
        println!(
            "{:?}: of clear cells free of obstacles {:.3} %; clear of road {:.2} %; occupied of obstacles {:.2} %",
            config.variant,
            100.0 * shares[0],
            100.0 * shares[1],
            100.0 * shares[2]
        );
    }
    let [polar, lines] = shares;
    // Over the local ground `polar` counts hits in dips too.
    assert!((0.68..polar[2]).contains(&lines[2]), "{polar:?} {lines:?}");
    assert!((0.99..polar[0]).contains(&lines[0]) && lines[1] > 0.92, "{polar:?} {lines:?}");
}
