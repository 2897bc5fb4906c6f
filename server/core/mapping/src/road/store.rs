//! The newest roads, and their points in the ego frame of a map.

use nalgebra::{Isometry3, Point3};

use crate::road::{Road, RoadFrame, RoadPurpose};

/// A checked road, and the pose of the vehicle at its stamp.
#[derive(Clone, Debug, PartialEq)]
pub struct StoredRoad {
    /// The road as its event brought it.
    pub road: Road,
    /// Ego frame in the world frame at the road's stamp; `None` if no pose was near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
}

impl StoredRoad {
    /// Writes the points to `points`, transformed into the ego frame of a vehicle at `map_from_ego`. Returns false and
    /// writes nothing if the road lies in the map frame and no pose is known. The points of a road in the ego frame are
    /// not moved if one of the two poses is unknown: the next road replaces it soon.
    pub fn points_in_ego(&self, map_from_ego: Option<&Isometry3<f64>>, points: &mut Vec<[f64; 2]>) -> bool {
        let (ego_from_road, z) = match (self.road.frame, map_from_ego, &self.map_from_ego) {
            (RoadFrame::Map, None, _) => return false,
            // Roads have no heights: their points get the height of the vehicle.
            (RoadFrame::Map, Some(now), _) => (now.inverse(), now.translation.z),
            (RoadFrame::Ego, Some(now), Some(at_stamp)) => (now.inverse() * at_stamp, 0.0),
            (RoadFrame::Ego, _, _) => (Isometry3::identity(), 0.0),
        };
        let to_ego = |&[x, y]: &[f64; 2]| {
            let point = ego_from_road * Point3::new(x, y, z);
            [point.x, point.y]
        };
        points.clear();
        points.extend(self.road.points.iter().map(to_ego));
        true
    }
}

/// The newest road of each purpose.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Roads {
    paint: Option<StoredRoad>,
    route: Option<StoredRoad>,
}

impl Roads {
    /// Replaces the newest road of the same purpose by a road that `road::check` has accepted.
    pub fn insert(&mut self, road: &Road, map_from_ego: Option<Isometry3<f64>>) {
        let stored = Some(StoredRoad { road: road.clone(), map_from_ego });
        match road.purpose {
            RoadPurpose::Paint => self.paint = stored,
            RoadPurpose::Route => self.route = stored,
        }
    }

    /// The newest road to paint; `None` before the first.
    pub fn to_paint(&self) -> Option<&StoredRoad> {
        self.paint.as_ref()
    }

    /// The newest route; `None` before the first.
    pub fn route(&self) -> Option<&StoredRoad> {
        self.route.as_ref()
    }

    /// Stamp of the newest road of a purpose, ns since the Unix epoch; `None` before the first.
    pub fn newest_stamp_ns(&self, purpose: RoadPurpose) -> Option<i64> {
        let newest = match purpose {
            RoadPurpose::Paint => &self.paint,
            RoadPurpose::Route => &self.route,
        };
        newest.as_ref().map(|stored| stored.road.stamp_ns)
    }
}
