//! Latitude and longitude -> metres in a local map frame.

/// A local map frame around a point on Earth: x east, y north, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    latitude_rad: f64,
    longitude_rad: f64,
}

impl LocalFrame {
    /// The frame whose origin is at this latitude and longitude.
    pub fn new(latitude_deg: f64, longitude_deg: f64) -> Self {
        Self { latitude_rad: latitude_deg.to_radians(), longitude_rad: longitude_deg.to_radians() }
    }

    /// Position of a latitude and longitude: distance east and north of the origin, metres. It uses the curvatures of
    /// the WGS 84 ellipsoid half-way; within 10 km of the origin the error is less than 0.1 m.
    pub fn position_m(&self, latitude_deg: f64, longitude_deg: f64) -> [f64; 2] {
        // WGS 84, the ellipsoid of GPS.
        const SEMI_MAJOR_M: f64 = 6_378_137.0;
        const ECCENTRICITY_SQUARED: f64 = 6.694_379_990_14e-3;
        let (latitude, longitude) = (latitude_deg.to_radians(), longitude_deg.to_radians());
        let (sin, cos) = libm::sincos((latitude + self.latitude_rad) / 2.0);
        let w = 1.0 - ECCENTRICITY_SQUARED * sin * sin;
        let across_m = SEMI_MAJOR_M / w.sqrt();
        let along_m = SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQUARED) / (w * w.sqrt());
        [(longitude - self.longitude_rad) * cos * across_m, (latitude - self.latitude_rad) * along_m]
    }
}
