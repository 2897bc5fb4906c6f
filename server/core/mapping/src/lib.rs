//! Events in, maps out: the papers' algorithms as pure functions of the events.
//!
//! | file | in -> out |
//! |---|---|
//! | [`event`] | what enters: datagrams, scans, ego poses, roads, losses |
//! | [`config`] | one vehicle's sensors and maps |
//! | [`pipeline`] | `step(&Event)` conducts the hops below |
//! | [`ledger`] | what came of every event, and why not |
//! | `intake` | one sensor's events -> its newest turn |
//! | `rings` | a scan's rings -> elevations of the lasers that drew them |
//! | [`body`] | returns on or behind the vehicle itself |
//! | [`fusion`] | whose turn makes a map, and the newest turns of all sensors in it |
//! | [`mount`] | first revolutions -> height, pitch and roll of a sensor nobody measured |
//! | [`motion`] | ego poses, speed + revolution -> where the vehicle was at each firing |
//! | [`sweep`] | revolution or scan + extrinsics -> [`sweep::Sweep`] in the ego frame |
//! | [`map`] | what a map is: geometry, legend, channels |
//! | [`radial`] | the thesis' r-θ grid: position -> cell |
//! | [`drivability`] | thesis §IV |
//! | [`height_difference`] | the thesis' baseline |
//! | [`scan_file`] | KITTI `.bin`, `.pcd` -> scan |
//! | [`series`] | revolution -> how far each range lies from its laser's neighbouring ones |
//! | [`terrain`] | Neuhaus 2009 §2 |
//! | [`occupancy`] | Seo 2014 §2 |
//! | [`road`] | RDDF and RNDF files, checked roads |
//! | [`speed`] | Lindström 2005 |
//! | [`safe_path`] | thesis §VI |

pub mod config;
pub mod event;
pub mod fusion;
pub mod layer;
pub mod ledger;
pub mod map;
pub mod pipeline;
pub mod road;
pub mod scan_file;
pub mod sensor;
