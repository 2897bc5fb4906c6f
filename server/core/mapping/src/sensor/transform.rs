//! Rigid transforms of points in single precision.

use nalgebra::Isometry3;

/// A rigid transform in single precision. It rounds by 8 µm at 120 m, where the sensor's own step is 2 mm.
#[derive(Clone, Copy)]
pub struct Transform {
    rotation: [[f32; 3]; 3],
    translation: [f32; 3],
}

impl Transform {
    pub fn new(ego_from_sensor: &Isometry3<f64>) -> Self {
        let rotation = ego_from_sensor.rotation.to_rotation_matrix();
        let translation = ego_from_sensor.translation;
        let row = |i: usize| [0, 1, 2].map(|j| rotation[(i, j)] as f32);
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: [translation.x as f32, translation.y as f32, translation.z as f32],
        }
    }

    /// A transform between two that differ by the motion of a millisecond; linear, which is as good as the arc there.
    #[inline(always)]
    pub fn towards(&self, to: &Self, share: f32) -> Self {
        let mix = |a: f32, b: f32| a + share * (b - a);
        let row = |i: usize| [0, 1, 2].map(|j| mix(self.rotation[i][j], to.rotation[i][j]));
        Self {
            rotation: [row(0), row(1), row(2)],
            translation: [0, 1, 2].map(|i| mix(self.translation[i], to.translation[i])),
        }
    }

    #[inline(always)]
    pub fn apply(&self, x: f32, y: f32, z: f32) -> [f32; 3] {
        let axis = |i: usize| {
            let [a, b, c] = self.rotation[i];
            a * x + b * y + c * z + self.translation[i]
        };
        [axis(0), axis(1), axis(2)]
    }
}
