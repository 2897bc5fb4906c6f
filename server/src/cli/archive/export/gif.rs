//! The pictures of a layer, in their order -> one GIF that plays at the speed of the drive.

use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

use anyhow::{Result, bail};
use gif::{DisposalMethod, Encoder, Frame, Repeat};

use crate::cli::shared::files;
use clearway_daemon::encode::picture::Picture;

/// Place of the width and the height in a GIF.
const SIZE_AT: u64 = 6;
/// Shortest time that viewers show a frame for, and the longest here, in hundredths of a second. Ours: a gap in the
/// drive is seen, and does not stop the film.
const DELAY: std::ops::RangeInclusive<i64> = 2..=200;
/// Time that the last frame stays, in hundredths of a second.
const LAST_DELAY: u16 = 100;
/// How fast, and how roughly, more than 256 colours are reduced to 256; the least rough of the fast ones.
const REDUCTION: i32 = 10;

/// A GIF that is being written. It repeats for ever.
pub struct Gif {
    encoder: Encoder<BufWriter<File>>,
    /// The greatest width and height of a frame.
    size: (u16, u16),
    /// The newest frame, whose time ends with the next, and its stamp.
    newest: Option<(Frame<'static>, i64)>,
}

impl Gif {
    /// Creates the file.
    ///
    /// # Errors
    /// If it exists or cannot be created.
    pub fn create(path: &Path) -> Result<Self> {
        let file = files::create_new(path)?;
        let mut encoder = Encoder::new(BufWriter::new(file), 0, 0, &[])?;
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Self { encoder, size: (0, 0), newest: None })
    }

    /// Adds a picture of a map with this stamp, in ns.
    ///
    /// # Errors
    /// If the picture is larger than a GIF can be, or the file cannot be written.
    pub fn push(&mut self, picture: &Picture, stamp_ns: i64) -> Result<()> {
        let (Ok(width), Ok(height)) = (u16::try_from(picture.width), u16::try_from(picture.height)) else {
            bail!("a picture of {} x {} pixels: a GIF has at most 65535 x 65535", picture.width, picture.height);
        };
        self.size = (self.size.0.max(width), self.size.1.max(height));
        let mut frame = Frame::from_rgb_speed(width, height, picture.rgb.as_flattened(), REDUCTION);
        frame.dispose = DisposalMethod::Background;
        if let Some((last, last_ns)) = self.newest.replace((frame, stamp_ns)) {
            let delay = (stamp_ns.saturating_sub(last_ns) + 5_000_000) / 10_000_000;
            self.write(last, delay.clamp(*DELAY.start(), *DELAY.end()) as u16)?;
        }
        Ok(())
    }

    /// Writes the last frame and the end of the file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn finish(mut self) -> Result<()> {
        if let Some((last, _)) = self.newest.take() {
            self.write(last, LAST_DELAY)?;
        }
        let mut file = self.encoder.into_inner()?;
        // The size is known now: pictures with more lines under the map are higher.
        file.seek(SeekFrom::Start(SIZE_AT))?;
        file.write_all(&[self.size.0.to_le_bytes(), self.size.1.to_le_bytes()].concat())?;
        Ok(file.flush()?)
    }

    fn write(&mut self, mut frame: Frame<'static>, delay: u16) -> Result<()> {
        frame.delay = delay;
        Ok(self.encoder.write_frame(&frame)?)
    }
}
