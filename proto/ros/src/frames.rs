//! Transforms -> where one frame lies in another: the tree that `/tf` and `/tf_static` tell of.

use std::collections::BTreeMap;

use nalgebra::Isometry3;

use crate::pose::StampedTransform;

/// Frames from a leaf to its root; a longer chain is a ring.
const DEPTH_MAX: usize = 64;
/// Frames kept; names beyond are made up by a peer that means no good.
const FRAMES_MAX: usize = 4096;

/// The newest transform of each frame to its parent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frames {
    parents: BTreeMap<String, (String, Isometry3<f64>)>,
}

impl Frames {
    /// Takes a transform in place of the child's former one; `false` where there are too many frames already.
    pub fn take(&mut self, transform: &StampedTransform) -> bool {
        let child = name(transform.child_frame_id);
        if self.parents.len() >= FRAMES_MAX && !self.parents.contains_key(child) {
            return false;
        }
        let parent = name(transform.header.frame_id).to_owned();
        self.parents.insert(child.to_owned(), (parent, transform.parent_from_child));
        true
    }

    /// Whether the frame hangs on another one, or another one on it.
    pub fn knows(&self, frame: &str) -> bool {
        let frame = name(frame);
        self.parents.contains_key(frame) || self.parents.values().any(|(parent, _)| parent == frame)
    }

    /// Carries points of `b` into `a`; `None` where no chain of transforms joins them. A frame lies in itself unmoved.
    pub fn a_from_b(&self, a: &str, b: &str) -> Option<Isometry3<f64>> {
        let (up_from_a, up_from_b) = (self.up(name(a)), self.up(name(b)));
        // The first frame above b that is above a too.
        up_from_b.iter().find_map(|(frame, common_from_b)| {
            let (_, common_from_a) = up_from_a.iter().find(|(above, _)| above == frame)?;
            Some(common_from_a.inverse() * common_from_b)
        })
    }

    /// The frame and all above it, each with `above_from_frame`.
    fn up<'a>(&'a self, frame: &'a str) -> Vec<(&'a str, Isometry3<f64>)> {
        let mut chain = vec![(frame, Isometry3::identity())];
        while let Some((parent, parent_from_child)) = self.parents.get(chain[chain.len() - 1].0) {
            if chain.len() > DEPTH_MAX {
                break;
            }
            let above_from_frame = parent_from_child * chain[chain.len() - 1].1;
            chain.push((parent, above_from_frame));
        }
        chain
    }

    /// How many transforms above `frame` its `ancestor` stands; 0 where they are the same, `None` where it is none.
    pub fn steps_up(&self, frame: &str, ancestor: &str) -> Option<usize> {
        self.up(name(frame)).iter().position(|(above, _)| *above == name(ancestor))
    }
}

/// A frame's name as tf2 has it; the tf of ROS 1 put a slash before it, and some drivers still do.
pub fn name(frame_id: &str) -> &str {
    frame_id.strip_prefix('/').unwrap_or(frame_id)
}
