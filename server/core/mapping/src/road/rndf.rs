//! RNDF, the route network definition file of DARPA's Urban Challenge: its lanes.
//!
//! In: text, a keyword or waypoint a line, `/* comments */`, widths in feet. Out: [`Rndf`], and from each lane a
//! [`Road`] in the map frame. A waypoint that is none, or a lane without two of them, is left out and named; the others
//! stand. Exits, stops, checkpoints and zones are no part of a lane's shape and are passed over.

use super::{FOOT_M, LineRefused, LocalFrame, latitude, longitude, number};
use crate::event::{Road, RoadFrame, RoadPurpose};

/// A network's lanes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rndf {
    /// In the file's order.
    pub lanes: Vec<Lane>,
    /// Lines left out; a lane left out stands under its first line.
    pub refused: Vec<LineRefused>,
}

/// One lane.
#[derive(Clone, Debug, PartialEq)]
pub struct Lane {
    /// `segment.lane`, as in the file.
    pub name: String,
    /// Whole width; `None` where the file states none.
    pub width_m: Option<f64>,
    /// Latitude and longitude, degrees, in driving order.
    pub waypoints_deg: Vec<[f64; 2]>,
}

impl Rndf {
    /// Reads a whole file.
    pub fn read(text: &str) -> Self {
        let mut rndf = Self::default();
        // The lane being read, and its first line.
        let mut open: Option<(usize, Lane)> = None;
        for (index, line) in without_comments(text).lines().enumerate() {
            let line_number = index + 1;
            let mut words = line.split_whitespace();
            let Some(keyword) = words.next() else { continue };
            let taken = match (keyword, &mut open) {
                ("lane", _) => {
                    rndf.close(open.take());
                    let name = words.next().unwrap_or("").to_owned();
                    open = Some((line_number, Lane { name, width_m: None, waypoints_deg: Vec::new() }));
                    Ok(())
                }
                ("end_lane" | "end_segment" | "segment" | "zone" | "end_file", _) => {
                    rndf.close(open.take());
                    Ok(())
                }
                ("lane_width", Some((_, lane))) => read_width(line_number, words.next(), lane),
                (id, Some((_, lane))) if id.starts_with(|c: char| c.is_ascii_digit()) => {
                    read_waypoint(line_number, id, words.next(), words.next(), lane)
                }
                _ => Ok(()),
            };
            rndf.refused.extend(taken.err());
        }
        rndf.close(open.take());
        rndf
    }

    fn close(&mut self, lane: Option<(usize, Lane)>) {
        let Some((line, lane)) = lane else { return };
        if lane.waypoints_deg.len() >= 2 {
            self.lanes.push(lane);
            return;
        }
        let found = format!("{} waypoint(s) of lane {}", lane.waypoints_deg.len(), lane.name);
        self.refused.push(LineRefused { line, what: "lane", found, allowed: "2 waypoints or more" });
    }

    /// A map frame about the first lane's first waypoint.
    pub fn local_frame(&self) -> Option<LocalFrame> {
        let &[latitude_deg, longitude_deg] = self.lanes.first()?.waypoints_deg.first()?;
        Some(LocalFrame::about(latitude_deg, longitude_deg))
    }
}

impl Lane {
    /// The lane as a road to paint, in a map frame about a place on Earth; as wide as the file says, else
    /// `width_m_default`. `None` where neither is known.
    pub fn road(&self, frame: &LocalFrame, width_m_default: Option<f64>, stamp_ns: i64) -> Option<Road> {
        let width_m = self.width_m.or(width_m_default)?;
        Some(Road {
            stamp_ns,
            purpose: RoadPurpose::Paint,
            frame: RoadFrame::Map,
            points: self.waypoints_deg.iter().map(|&[latitude, longitude]| frame.metres(latitude, longitude)).collect(),
            widths_m: vec![width_m; self.waypoints_deg.len()],
            orientations: Vec::new(),
        })
    }
}

fn read_width(line: usize, field: Option<&str>, lane: &mut Lane) -> Result<(), LineRefused> {
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
) -> Result<(), LineRefused> {
    // 1.2.3 is waypoint 3 of lane 1.2.
    if id.rsplit_once('.').is_none_or(|(of, _)| of != lane.name) {
        let allowed = "a waypoint of the lane it stands in";
        return Err(LineRefused { line, what: "waypoint", found: id.to_owned(), allowed });
    }
    let place = [latitude(line, latitude_field)?, longitude(line, longitude_field)?];
    if lane.waypoints_deg.last() == Some(&place) {
        let found = format!("{} {}", place[0], place[1]);
        return Err(LineRefused { line, what: "place", found, allowed: "not the waypoint's before" });
    }
    lane.waypoints_deg.push(place);
    Ok(())
}

/// The text with comments blanked; lines keep their numbers. A comment that is not closed ends with its line.
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
