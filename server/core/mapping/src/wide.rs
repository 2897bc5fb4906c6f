//! Loops over points with the widest registers that the processor has.
//!
//! The build is for every x86-64, whose registers hold four numbers; most processors have AVX2, whose registers hold
//! eight. A [`WideLoop`] is compiled for both, and the processor at hand chooses. Each number is computed by the same
//! operations in the same order, so that both give the same bytes.

use pulp::{Arch, Simd, WithSimd};

/// A loop that is compiled for several processors. [`Self::run`] and all that it calls must be `#[inline(always)]`,
/// else they are compiled for the least of them.
pub(crate) trait WideLoop {
    /// Runs the loop.
    fn run(self);
}

/// Runs a loop on the best registers of this processor.
pub(crate) fn run_wide(work: impl WideLoop) {
    struct Wide<L>(L);

    impl<L: WideLoop> WithSimd for Wide<L> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) {
            self.0.run();
        }
    }

    #[cfg(test)]
    if tests::IS_PLAIN.get() {
        return work.run();
    }
    Arch::new().dispatch(Wide(work));
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use nalgebra::Isometry3;

    use crate::config::{Extrinsics, SensorConfig, VehicleConfig};
    use crate::event::{Body, EgoPose, Event, Scan};
    use crate::map::Map;
    use crate::pipeline::Pipeline;

    thread_local! {
        /// True if loops of this thread run as the build for every x86-64 has them.
        pub static IS_PLAIN: Cell<bool> = const { Cell::new(false) };
    }

    /// Rings on rough ground between walls, 32 lasers, 1 m further on with each number.
    fn scan(number: i64) -> Scan {
        let mut scan = Scan { stamp_ns: number * 100_000_000, ..Scan::default() };
        for (ring, step) in (0..32_u16).flat_map(|ring| (0..900).map(move |step| (ring, step))) {
            let elevation = (f32::from(ring) - 24.0).to_radians();
            let (sin, cos) = libm::sincosf((step as f32 * 0.4).to_radians());
            let rough_m = ((u32::from(ring) * 977 + step * 131) % 17) as f32 * 0.004;
            let to_wall_m = (6.0 / sin.abs()).min((25.0 - number as f32) / cos.max(1e-3));
            let to_ground_m = (1.9 - rough_m) / (-libm::tanf(elevation)).max(1e-3);
            let range_m = to_wall_m.min(to_ground_m).min(90.0);
            scan.x.push(range_m * cos);
            scan.y.push(range_m * sin);
            scan.z.push(range_m * libm::tanf(elevation));
            scan.intensity.push(0.5);
            scan.ring.push(ring);
        }
        scan
    }

    /// The maps of a drive with all layers, and with `freespace` alone.
    fn maps(is_plain: bool) -> Vec<Map> {
        IS_PLAIN.set(is_plain);
        let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: 1.9, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
        let config = VehicleConfig::new("car", vec![SensorConfig::new("top", extrinsics)]);
        let mut made = Vec::new();
        for is_alone in [false, true] {
            let mut pipeline = Pipeline::new(&config, vec![None]).unwrap();
            pipeline.set_active_layers(|layer| layer == "freespace" || !is_alone);
            for number in 1..6 {
                let scan = scan(number);
                let stamp_ns = scan.stamp_ns;
                let map_from_ego = Isometry3::translation(number as f64, 0.0, 0.0);
                for body in [Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps: 10.0 }), Body::Scan(scan)] {
                    let event = Event { sequence: 0, arrival_ns: stamp_ns, source: 0, body };
                    made.extend(pipeline.step(&event).unwrap().cloned());
                }
            }
        }
        made
    }

    #[test]
    fn maps_are_the_same_with_wide_registers_and_without() {
        let [wide, plain] = [false, true].map(maps);
        assert_eq!(wide.len(), 10);
        let layers: Vec<_> = wide.iter().map(|map| map.layers.len()).collect();
        assert_eq!(layers, [7, 7, 7, 7, 7, 1, 1, 1, 1, 1]);
        let free_m2 = |map: &Map| map.layers.last().map(|layer| layer.metrics[0].1);
        assert!(
            wide.iter().all(|map| free_m2(map) > Some(100.0)),
            "{:?}",
            wide.iter().map(free_m2).collect::<Vec<_>>()
        );
        for (wide, plain) in wide.iter().zip(&plain) {
            for (wide, plain) in wide.layers.iter().zip(&plain.layers) {
                assert!(wide == plain, "{} differs", wide.name);
            }
        }
    }
}
