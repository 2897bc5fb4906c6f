//! What a layer is, what it is made from, and the trait that makes it.
//!
//! In: the points of one map ([`Sweep`] and [`Context`]), and between two maps the scan of each sensor ([`Rays`]).
//! Out: a [`Layer`]: channels over one grid.

use nalgebra::Isometry3;

use crate::ground::Ground;
use crate::layer::channel::Channel;
use crate::layer::class::ClassInfo;
use crate::layer::grid::Geometry;
use crate::layer::radial_points::{RadialPoints, RadialSize};
use crate::memory::MemoryState;
use crate::reach::{Reach, ReachCell};
use crate::road::StoredRoad;
use crate::sensor::rays::{Rays, ScanExtras};
use crate::sensor::sweep::Sweep;

/// One named grid of a map, with its channels.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// `drivability`, `height_difference`, …
    pub name: &'static str,
    /// Where the cells lie.
    pub geometry: Geometry,
    /// The classes by value of the channel `class`; entry 0 is [`ClassInfo::UNKNOWN`].
    pub legend: &'static [ClassInfo],
    /// The channels; the first is `class`.
    pub channels: Vec<Channel>,
    /// Planes z = ax + by + c, ego frame, metres, by segment id; empty for layers without segments.
    pub planes: Vec<[f64; 3]>,
    /// Named numbers about the whole layer (`drivable_share`, …).
    pub metrics: Vec<(&'static str, f64)>,
    /// Safe points; the first is the vehicle's own position. Empty for layers without safe points.
    pub points: Vec<SafePoint>,
}

impl Layer {
    /// A layer whose channels have no cells.
    pub fn new(name: &'static str, geometry: Geometry, legend: &'static [ClassInfo], channels: Vec<Channel>) -> Self {
        Self { name, geometry, legend, channels, planes: Vec::new(), metrics: Vec::new(), points: Vec::new() }
    }

    /// Empties the lists beside the cells: planes, metrics and points.
    pub fn clear_lists(&mut self) {
        self.planes.clear();
        self.metrics.clear();
        self.points.clear();
    }
}

/// A position with the greatest distance to the obstacles on both sides of it, ego frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SafePoint {
    /// Distance forward of the ego origin, metres.
    pub x_m: f64,
    /// Distance to the left of the ego origin, metres.
    pub y_m: f64,
    /// Distance to the nearest cell that is not free, metres.
    pub radius_m: f64,
    /// Indices of the points the vehicle can drive to from here. All come before this point in the list, so that each
    /// link is listed once.
    pub links: Vec<u32>,
}

/// What a layer may use beside the points of the map.
#[derive(Clone, Copy, Default)]
pub struct Context<'a> {
    /// The layers of the same map that were made before this one, in the map's order.
    pub earlier: &'a [Layer],
    /// The map's `capture_end_ns`, ns since the Unix epoch.
    pub stamp_ns: i64,
    /// Scans that ended before this stamp no longer count, ns since the Unix epoch.
    pub earliest_ns: i64,
    /// Ego frame in the world frame at `stamp_ns`; `None` if no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Local ground of the sweep; `None` if heights are taken over the plane under the vehicle.
    pub ground: Option<&'a Ground>,
    /// The radial cells of the sweep's points, for each size that layers share ([`LayerMaker::radial_size`]).
    pub radial: &'a [RadialPoints],
    /// What the vehicle can reach; `None` if layers do not consider it.
    pub reach: Option<&'a Reach>,
    /// What the map got from memory; `None` without a memory.
    pub memory: Option<MemoryState>,
    /// Newest road to paint.
    pub road: Option<&'a StoredRoad>,
    /// Newest route.
    pub route: Option<&'a StoredRoad>,
}

impl<'a> Context<'a> {
    /// Height of each point of the map's sweep over the ground, metres; NaN for a point that may be ground where no
    /// ground is known. Such a point proves nothing.
    pub fn heights_m(&self, sweep: &'a Sweep) -> &'a [f32] {
        self.ground.map_or(&sweep.z, Ground::heights_m)
    }

    /// Azimuth of each point of the map's sweep, in columns of two degrees; `None` if they were not computed.
    pub fn azimuths(&self) -> Option<&'a [f32]> {
        self.ground.map(Ground::azimuths)
    }

    /// Height of the ground at a position, ego frame, metres.
    #[inline(always)]
    pub fn ground_m(&self, x: f32, y: f32) -> f32 {
        self.ground.map_or(0.0, |ground| ground.height_m(x, y))
    }

    /// True if the vehicle can get to a position.
    #[inline(always)]
    pub fn is_reached(&self, x: f32, y: f32) -> bool {
        self.reach.is_none_or(|reach| reach.is_reached(ReachCell::at(x, y)))
    }

    /// True if an obstacle stands at a position, or a step of the ground ends there.
    #[inline(always)]
    pub fn is_closed(&self, x: f32, y: f32) -> bool {
        self.reach.is_some_and(|reach| reach.is_closed(ReachCell::at(x, y)))
    }

    /// The radial cells of the sweep's points; `own` finds them if no other layer shares them.
    pub fn radial_points<'b>(&self, sweep: &Sweep, own: &'b mut RadialPoints) -> &'b RadialPoints
    where
        'a: 'b,
    {
        match self.radial.iter().find(|shared| shared.size() == own.size()) {
            Some(shared) => shared,
            None => {
                own.find(sweep, self.azimuths());
                own
            }
        }
    }
}

/// A copy of a maker whose trait alone is known.
pub trait CloneMaker {
    /// A copy with the same evidence.
    fn cloned(&self) -> Box<dyn LayerMaker>;
}

impl<T: LayerMaker + Clone + 'static> CloneMaker for T {
    fn cloned(&self) -> Box<dyn LayerMaker> {
        Box::new(self.clone())
    }
}

impl Clone for Box<dyn LayerMaker> {
    fn clone(&self) -> Self {
        (**self).cloned()
    }
}

/// Makes one layer for map after map, reusing its buffers.
pub trait LayerMaker: CloneMaker + Send {
    /// The layer without cells.
    fn layer(&self) -> Layer;

    /// Names of the earlier layers this one is made from.
    fn needs(&self) -> &'static [&'static str] {
        &[]
    }

    /// The radial grid of a layer that takes the points' cells from [`Context::radial_points`].
    fn radial_size(&self) -> Option<RadialSize> {
        None
    }

    /// The optional data of a scan this layer uses.
    fn uses(&self) -> ScanExtras {
        ScanExtras { ground: true, reached: true, ..ScanExtras::default() }
    }

    /// Adds the evidence of one sensor's scan. The pipeline calls it for each scan when the scan ends, in the order of
    /// the events. Layers that are made from the map's points alone ignore it.
    fn integrate(&mut self, rays: &Rays<'_>) {
        let _ = rays;
    }

    /// Makes the layer of one map in `layer`, which [`LayerMaker::layer`] created, in place of its former content.
    /// Every cell is written.
    fn make(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer);
}
