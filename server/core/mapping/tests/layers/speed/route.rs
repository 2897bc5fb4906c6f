//! The corridor and the speed limits of the route.

use super::*;

#[test]
fn a_road_outside_the_corridor_of_the_route_has_no_bonus() {
    let sweep = level();
    let road = stored(straight(6.0));
    // The corridor is 4 m wide and lies 2 m to the left of the road's middle.
    let narrow = Road { widths_m: vec![4.0; 2], ..route(vec![[-30.0, 2.0], [30.0, 2.0]]).road };
    let context = |route| Context { road: Some(&road), route: Some(route), ..Context::default() };
    let narrow = stored(narrow);
    let layer = make(&fine(Bonus::Uniform), &sweep, &context(&narrow));
    let at = |layer: &Layer, y: f32| {
        let cell = cell_at(layer, 5.1, y).unwrap();
        (classes(layer)[cell], f64::from(values(layer, "speed")[cell]) * f64::from(SPEED_SCALE_MPS))
    };
    assert_eq!([0.6, 2.6, 3.6].map(|y| at(&layer, y)), [(ROAD, 18.0), (ROAD, 18.0), (PASSABLE, 10.0)]);
    assert_eq!([-0.6, -2.6].map(|y| at(&layer, y)), [(PASSABLE, 10.0); 2]);
    let open = SpeedConfig { corridor: false, ..fine(Bonus::Uniform) };
    assert_eq!(at(&make(&open, &sweep, &context(&narrow)), -0.6), (ROAD, 18.0));
}

#[test]
fn the_speed_limits_of_the_route_cap_the_speed_in_their_part() {
    let sweep = level();
    let road = stored(straight(6.0));
    let limits = vec![12.0, 0.0, 0.75, 0.1];
    let points = vec![[-30.0, 0.0], [-5.0, 0.0], [5.0, 0.0], [12.0, 0.0]];
    let limited = stored(Road { speed_limits_mps: limits, widths_m: vec![8.0; 4], ..route(points).road });
    let context = Context { road: Some(&road), route: Some(&limited), ..Context::default() };
    let layer = make(&fine(Bonus::Uniform), &sweep, &context);
    let at = |layer: &Layer, x: f32, y: f32| {
        f64::from(values(layer, "speed")[cell_at(layer, x, y).unwrap()]) * f64::from(SPEED_SCALE_MPS)
    };
    assert_eq!([at(&layer, -10.1, 0.1), at(&layer, 0.1, 0.1), at(&layer, 10.1, 0.1)], [12.0, 18.0, 0.75]);
    assert_eq!([at(&layer, -10.1, 3.6), at(&layer, -10.1, 4.6)], [10.0, 10.0], "a limit adds no speed");
    // No passable cell has the raw value of an unknown cell or of an obstacle.
    let unknown_mps = SpeedConfig::default().unknown_mps.into();
    for limit_mps in [unknown_mps, 0.01] {
        let slow = Road { speed_limits_mps: vec![limit_mps; 4], ..limited.road.clone() };
        let slow = stored(slow);
        let layer = make(&fine(Bonus::Uniform), &sweep, &Context { route: Some(&slow), ..context });
        let speed = at(&layer, 0.1, 0.1);
        assert!(speed > 0.0 && speed < unknown_mps, "{speed}");
    }
    let free = SpeedConfig { speed_limits: false, ..fine(Bonus::Uniform) };
    assert_eq!(at(&make(&free, &sweep, &context), 10.1, 0.1), 18.0);
}
