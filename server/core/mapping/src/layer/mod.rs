//! The seven maps, one folder each, and what they share.
//!
//! | file | content |
//! |---|---|
//! | `maker` | [`Layer`], and the trait [`LayerMaker`] that makes it |
//! | `class` | what each class of a layer is called, means and looks like |
//! | `channel` | one value a cell, typed |
//! | `grid` | where the cells lie |
//! | [`radial_grid`] | r-θ grid: position -> cell |
//! | [`roughness`] | deviations of the points -> roughness by cell, for `terrain` and `speed` |
//! | `own_outline` | no cell in the vehicle's outline is occupied |
//! | `registry` | the list of the seven layers; which layers are active |
//! | [`freespace`] | where the whole vehicle can drive: the layer to plan on; not in the papers |
//! | [`drivability`] | UT Austin thesis, section IV |
//! | [`height_difference`] | UT Austin thesis, section V: the baseline |
//! | [`terrain`] | Neuhaus 2009, section 2 |
//! | [`occupancy`] | Seo 2014, section 2 |
//! | [`speed`] | Lindström 2005 |
//! | [`safe_path`] | UT Austin thesis, section VI |
//!
//! The folder of a layer has `class.rs` (classes and channels), `config.rs` (parameters), the steps of the algorithm, a
//! maker in `mod.rs`, and a `README.md` for users. To add a layer, add its folder here, and one line to the list in
//! `registry`.

mod channel;
mod class;
pub mod drivability;
pub mod freespace;
mod grid;
pub mod height_difference;
mod maker;
pub mod occupancy;
mod own_outline;
pub mod radial_grid;
pub mod radial_points;
pub(crate) mod registry;
pub mod roughness;
pub mod safe_path;
pub mod speed;
pub mod terrain;

pub use channel::{CellType, Cells, Channel, TypedChannel};
pub use class::{ClassInfo, Meaning};
pub use grid::Geometry;
pub use maker::{Context, Layer, LayerMaker, SafePoint};
pub use registry::PAGES;

pub use crate::sensor::rays::Rays;
