//! The lanes of an RNDF, the route network definition file of DARPA's Urban Challenge.
//!
//! In: text with one keyword or waypoint a line, `/* comments */`, and widths in feet. Out: [`Rndf`], and from each
//! lane a [`Road`] in the map frame. A waypoint that cannot be read and a lane without two waypoints are left out and
//! reported; the others are used. Exits, stops, checkpoints and zones do not change the shape of a lane and are
//! ignored.

use crate::road::line::{FOOT_M, LineError, latitude, longitude, number};
use crate::road::local_frame::LocalFrame;
use crate::road::{Road, RoadFrame, RoadPurpose};

/// The lanes of a road network.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rndf {
    /// The lanes, in the order of the file.
    pub lanes: Vec<Lane>,
    /// The lines that are left out. A lane that is left out is reported by its first line.
    pub refused: Vec<LineError>,
}

/// One lane.
#[derive(Clone, Debug, PartialEq)]
pub struct Lane {
    /// Name of the lane in the file: `segment.lane`.
    pub name: String,
    /// Whole width, metres; `None` if the file states none.
    pub width_m: Option<f64>,
    /// Latitude and longitude, degrees, in driving order.
    pub waypoints_deg: Vec<[f64; 2]>,
}

impl Rndf {
    /// Reads a whole file.
    pub fn read(text: &str) -> Self {
        let mut rndf = Self::default();
        // The lane that is being read, and the number of its first line.
        let mut open: Option<(usize, Lane)> = None;
        for (index, line) in without_comments(text).lines().enumerate() {
            let line_number = index + 1;
            let mut words = line.split_whitespace();
            let Some(keyword) = words.next() else { continue };
            let result = match (keyword, &mut open) {
                ("lane", _) => {
                    rndf.end_lane(open.take());
                    let name = words.next().unwrap_or("").to_owned();
                    open = Some((line_number, Lane { name, width_m: None, waypoints_deg: Vec::new() }));
                    Ok(())
                }
                ("end_lane" | "end_segment" | "segment" | "zone" | "end_file", _) => {
                    rndf.end_lane(open.take());
                    Ok(())
                }
                ("lane_width", Some((_, lane))) => read_width(line_number, words.next(), lane),
                (id, Some((_, lane))) if id.starts_with(|c: char| c.is_ascii_digit()) => {
                    read_waypoint(line_number, id, words.next(), words.next(), lane)
                }
                _ => Ok(()),
            };
            rndf.refused.extend(result.err());
        }
        rndf.end_lane(open.take());
        rndf
    }

    /// Adds a lane that has ended, or reports it if it has fewer than two waypoints.
    fn end_lane(&mut self, lane: Option<(usize, Lane)>) {
        let Some((line, lane)) = lane else { return };
        if lane.waypoints_deg.len() >= 2 {
            self.lanes.push(lane);
            return;
        }
        let found = format!("{} waypoint(s) of lane {}", lane.waypoints_deg.len(), lane.name);
        self.refused.push(LineError { line, what: "lane", found, allowed: "2 waypoints or more" });
    }

    /// A local frame whose origin is the first waypoint of the first lane; `None` without lanes.
    pub fn local_frame(&self) -> Option<LocalFrame> {
        let &[latitude_deg, longitude_deg] = self.lanes.first()?.waypoints_deg.first()?;
        Some(LocalFrame::new(latitude_deg, longitude_deg))
    }
}

impl Lane {
    /// The lane as a road to paint, in a local frame. Its width is the file's, or else `width_m_default`; `None` if
    /// neither is known.
    pub fn road(&self, frame: &LocalFrame, width_m_default: Option<f64>, stamp_ns: i64) -> Option<Road> {
        let width_m = self.width_m.or(width_m_default)?;
        Some(Road {
            stamp_ns,
            purpose: RoadPurpose::Paint,
            frame: RoadFrame::Map,
            points: self
                .waypoints_deg
                .iter()
                .map(|&[latitude, longitude]| frame.position_m(latitude, longitude))
                .collect(),
            widths_m: vec![width_m; self.waypoints_deg.len()],
            orientations: Vec::new(),
            speed_limits_mps: Vec::new(),
        })
    }
}

fn read_width(line: usize, field: Option<&str>, lane: &mut Lane) -> Result<(), LineError> {
    let feet = number((line, "lane_width"), field, f64::MIN_POSITIVE..=330.0, "more than 0, up to 330 ft")?;
    lane.width_m = Some(feet * FOOT_M);
    Ok(())
}

fn read_waypoint(
    line: usize,
    id: &str,
    latitude_field: Option<&str>,
    longitude_field: Option<&str>,
    lane: &mut Lane,
) -> Result<(), LineError> {
    // Waypoint 3 of lane 1.2 is written 1.2.3.
    if id.rsplit_once('.').is_none_or(|(lane_name, _)| lane_name != lane.name) {
        let allowed = "a waypoint of this lane";
        return Err(LineError { line, what: "waypoint", found: id.to_owned(), allowed });
    }
    let position = [latitude(line, latitude_field)?, longitude(line, longitude_field)?];
    if lane.waypoints_deg.last() == Some(&position) {
        let found = format!("{} {}", position[0], position[1]);
        return Err(LineError { line, what: "place", found, allowed: "not the waypoint's before" });
    }
    lane.waypoints_deg.push(position);
    Ok(())
}

/// The text without its comments; lines keep their numbers. A comment that is not closed ends with its line.
fn without_comments(text: &str) -> String {
    let mut kept = String::with_capacity(text.len());
    for line in text.lines() {
        let mut rest = line;
        while let Some((before, comment)) = rest.split_once("/*") {
            kept.push_str(before);
            rest = comment.split_once("*/").map_or("", |(_, after)| after);
        }
        kept.push_str(rest);
        kept.push('\n');
    }
    kept
}
