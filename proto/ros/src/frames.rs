//! Transforms -> pose of one frame in another: the tree of `/tf` and `/tf_static`.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Isometry3;

use crate::pose::StampedTransform;

/// Most frames from a leaf to its root. Ours; a longer chain is a cycle.
const DEPTH_MAX: usize = 64;
/// Most frames kept. Ours; it bounds the memory that a hostile peer can claim.
const FRAMES_MAX: usize = 4096;

/// The newest transform of each frame to its parent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frames {
    parents: BTreeMap<String, (String, Isometry3<f64>)>,
}

impl Frames {
    /// Inserts a transform, which replaces the child's former one. Returns false if there are too many frames.
    pub fn insert(&mut self, transform: &StampedTransform) -> bool {
        let child = name(transform.child_frame_id);
        if self.parents.len() >= FRAMES_MAX && !self.parents.contains_key(child) {
            return false;
        }
        let parent = name(transform.header.frame_id).to_owned();
        self.parents.insert(child.to_owned(), (parent, transform.parent_from_child));
        true
    }

    /// All frames that have a parent or a child, in alphabetical order.
    pub fn names(&self) -> BTreeSet<&str> {
        self.parents.iter().flat_map(|(child, (parent, _))| [child.as_str(), parent]).collect()
    }

    /// True if a transform places this frame in a parent.
    pub fn has_parent(&self, frame: &str) -> bool {
        self.parents.contains_key(name(frame))
    }

    /// Pose of frame `b` in frame `a`, which maps points of `b` to `a`; `None` if no chain of transforms joins them. It
    /// is the identity if both are the same frame.
    pub fn a_from_b(&self, a: &str, b: &str) -> Option<Isometry3<f64>> {
        let (up_from_a, up_from_b) = (self.up(name(a)), self.up(name(b)));
        // The first ancestor of b that is an ancestor of a too.
        up_from_b.iter().find_map(|(frame, common_from_b)| {
            let (_, common_from_a) = up_from_a.iter().find(|(above, _)| above == frame)?;
            Some(common_from_a.inverse() * common_from_b)
        })
    }

    /// The frame and its ancestors, each with `ancestor_from_frame`.
    fn up<'a>(&'a self, frame: &'a str) -> Vec<(&'a str, Isometry3<f64>)> {
        let mut chain = vec![(frame, Isometry3::identity())];
        while let Some((parent, parent_from_child)) = self.parents.get(chain[chain.len() - 1].0) {
            if chain.len() > DEPTH_MAX {
                break;
            }
            let ancestor_from_frame = parent_from_child * chain[chain.len() - 1].1;
            chain.push((parent, ancestor_from_frame));
        }
        chain
    }

    /// Number of transforms from `frame` up to its `ancestor`: 0 if they are the same, `None` if it is not an ancestor.
    pub fn steps_up(&self, frame: &str, ancestor: &str) -> Option<usize> {
        self.up(name(frame)).iter().position(|(above, _)| *above == name(ancestor))
    }
}

/// Name of a frame without the leading slash that ROS 1 and some drivers write.
pub fn name(frame_id: &str) -> &str {
    frame_id.strip_prefix('/').unwrap_or(frame_id)
}

/// Name of a frame without the namespace of its vehicle: `base_link` of `robot1/base_link`.
pub fn local_name(frame_id: &str) -> &str {
    frame_id.rsplit('/').next().unwrap_or(frame_id)
}
