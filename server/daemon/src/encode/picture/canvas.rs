//! The pixels of a picture, and where they lie in the ego frame.

/// The pixels of a picture while it is drawn.
pub struct Canvas {
    /// Pixels along each edge.
    pub side: usize,
    /// Distance from the vehicle to the edge, in metres.
    pub range_m: f64,
    /// Row by row from the upper left.
    pub rgb: Vec<[u8; 3]>,
}

impl Canvas {
    /// Edge of a pixel, in metres.
    pub fn pixel_m(&self) -> f64 {
        2.0 * self.range_m / self.side as f64
    }

    /// The point of the ego frame in the middle of a pixel.
    pub fn point(&self, index: usize) -> (f64, f64) {
        let metres = |pixel: usize| self.range_m - (pixel as f64 + 0.5) * self.pixel_m();
        (metres(index / self.side), metres(index % self.side))
    }

    /// Column and row of a point of the ego frame, in pixels from the upper left corner.
    pub fn pixels(&self, x_m: f64, y_m: f64) -> (f64, f64) {
        ((self.range_m - y_m) / self.pixel_m(), (self.range_m - x_m) / self.pixel_m())
    }
}
