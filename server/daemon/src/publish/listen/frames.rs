//! The bytes of an HTTP/2 client -> the frames that carry no data, which are limited.
//!
//! The library answers each PING and each SETTINGS, and examines every other frame: a client that sends nothing else
//! costs a core. It counts what is no such flood itself: streams that are reset early, empty DATA, long heads.

use super::budget::Budget;

/// Most frames without data at once. Ours: a client that opens all of its streams sends some hundreds.
const FRAMES_MAX: u32 = 1000;
/// How many more there may be each second. Ours: a client sends a PING every few seconds.
const FRAMES_PER_SECOND: u32 = 100;
/// How many more there may be for each piece of a response. Ours: a client that measures its link answers a piece with
/// a PING and two of WINDOW_UPDATE.
const FRAMES_PER_PIECE: u32 = 4;
/// Length of what a client sends before its first frame (RFC 9113, section 3.4), and of the head of a frame (4.1).
const PREFACE_BYTES: usize = 24;
const HEAD_BYTES: usize = 9;
/// Flag of the last frame of a request.
const END_STREAM: u8 = 1;

/// A client sends frames without data faster than any use of HTTP/2 needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a flood of {frame} frames")]
pub struct FloodError {
    /// The type of the frame that was one too many.
    pub frame: &'static str,
}

/// Counts the frames of one client.
#[derive(Debug)]
pub struct Frames {
    budget: Budget,
    /// Bytes until the next head.
    skip: usize,
    head: [u8; HEAD_BYTES],
    /// Bytes of the head so far.
    known: usize,
}

impl Frames {
    /// A connection that has sent nothing yet.
    pub fn new() -> Self {
        let budget = Budget::new(FRAMES_MAX, FRAMES_PER_SECOND);
        Self { budget, skip: PREFACE_BYTES, head: [0; HEAD_BYTES], known: 0 }
    }

    /// Counts what the client has sent since the last call, in which it was sent this many pieces of responses.
    ///
    /// # Errors
    /// [`FloodError`] if its frames without data exceed the limit.
    pub fn count(&mut self, mut bytes: &[u8], pieces: u32) -> Result<(), FloodError> {
        self.budget.add(pieces.saturating_mul(FRAMES_PER_PIECE));
        loop {
            let skipped = self.skip.min(bytes.len());
            (self.skip, bytes) = (self.skip - skipped, &bytes[skipped..]);
            let missing = (HEAD_BYTES - self.known).min(bytes.len());
            self.head[self.known..self.known + missing].copy_from_slice(&bytes[..missing]);
            (self.known, bytes) = (self.known + missing, &bytes[missing..]);
            if self.known < HEAD_BYTES {
                return Ok(());
            }
            let [high, middle, low, kind, flags, ..] = self.head;
            (self.known, self.skip) = (0, u32::from_be_bytes([0, high, middle, low]) as usize);
            if let Some(frame) = without_data(kind, flags, self.skip)
                && !self.budget.take()
            {
                return Err(FloodError { frame });
            }
        }
    }
}

/// The type of a frame, unless it carries data, or begins or ends a call (RFC 9113, section 6).
fn without_data(kind: u8, flags: u8, length: usize) -> Option<&'static str> {
    match kind {
        0 if length > 0 || flags & END_STREAM != 0 => None,
        0 => Some("empty DATA"),
        1 => None,
        2 => Some("PRIORITY"),
        3 => Some("RST_STREAM"),
        4 => Some("SETTINGS"),
        5 => Some("PUSH_PROMISE"),
        6 => Some("PING"),
        7 => Some("GOAWAY"),
        8 => Some("WINDOW_UPDATE"),
        9 => Some("CONTINUATION"),
        _ => Some("unknown"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(kind: u8, length: u8) -> Vec<u8> {
        [&[0, 0, length, kind, 0, 0, 0, 0, 0][..], &vec![6; usize::from(length)]].concat()
    }

    fn opened() -> Frames {
        let mut frames = Frames::new();
        frames.count(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 0).unwrap();
        frames
    }

    #[test]
    fn a_flood_is_named_however_its_bytes_are_cut() {
        for (kind, name) in [(0, "empty DATA"), (2, "PRIORITY"), (4, "SETTINGS"), (6, "PING"), (200, "unknown")] {
            let length = if kind == 0 { 0 } else { 8 };
            let flood = frame(kind, length).repeat(2 * FRAMES_MAX as usize);
            for size in [1, 5, 9, 17, 4096, flood.len()] {
                let mut frames = opened();
                let cut = flood.chunks(size).find_map(|bytes| frames.count(bytes, 0).err());
                assert_eq!(cut, Some(FloodError { frame: name }), "in pieces of {size} bytes");
            }
        }
    }

    #[test]
    fn data_and_calls_are_never_a_flood_and_answers_to_pieces_are_none() {
        let mut frames = opened();
        let (data, head, ping) = (frame(0, 1), frame(1, 30), frame(6, 8));
        for _ in 0..10 * FRAMES_MAX {
            frames.count(&[&data[..], &head].concat(), 0).unwrap();
            frames.count(&ping.repeat(3), 1).unwrap();
        }
    }
}
