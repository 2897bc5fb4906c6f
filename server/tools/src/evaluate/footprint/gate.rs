//! A condition on the footprints of a layer, for `--fail-under`.
//!
//! In: `LAYER=PERCENT` or `LAYER=PERCENT@FROM-TO` in metres. Out: a [`FootprintGate`], and why counts do not pass it.

use std::fmt;
use std::str::FromStr;

use super::tally::{BANDS_M, FootprintTally};

/// Range of a gate that names none, in metres.
const RANGE_M: (f64, f64) = (4.0, 20.0);

/// The least share of the free footprints on one level that a layer must answer free. No footprint that holds a thing
/// of 0.5 m, or of 0.3 m within 20 m, may be answered free.
#[derive(Clone, Debug, PartialEq)]
pub struct FootprintGate {
    /// Name of the layer.
    pub layer: String,
    /// The least share, in percent.
    pub percent: f64,
    /// The range of the footprints' middles, in metres; both are bounds of bands.
    pub range_m: (f64, f64),
}

impl FootprintGate {
    /// Why these counts do not pass; `None` if they do. Counts without a free footprint do not pass, because they show
    /// nothing.
    pub fn failure(&self, tally: &FootprintTally) -> Option<String> {
        let count = tally.level_within(self.range_m.0, self.range_m.1);
        let grave = tally.grave();
        let share = count.share().map(|share| 100.0 * share);
        match share {
            None => Some("no free footprint to judge".into()),
            Some(share) if share < self.percent => Some(format!(
                "{share:.2} % of {} free footprints answered free, at least {} % are needed",
                count.all, self.percent
            )),
            Some(_) if grave > 0 => {
                Some(format!("{grave} footprint(s) answered free that hold a thing of 0.5 m, or of 0.3 m within 20 m"))
            }
            Some(_) => None,
        }
    }
}

impl FromStr for FootprintGate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let allowed = || {
            let bounds = BANDS_M.map(|bound| bound.to_string()).join(", ");
            format!(
                "{text:?}: LAYER=PERCENT or LAYER=PERCENT@FROM-TO is allowed, such as freespace=96@4-20, with a percentage \
                 of 0 to 100 and ranges of {bounds} m"
            )
        };
        let (layer, rest) = text.split_once('=').ok_or_else(allowed)?;
        let (percent, range) = rest.split_once('@').map_or((rest, None), |(percent, range)| (percent, Some(range)));
        let number = |text: &str| text.parse::<f64>().map_err(|_| allowed());
        let range_m = match range {
            None => RANGE_M,
            Some(range) => {
                let (from, to) = range.split_once('-').ok_or_else(allowed)?;
                (number(from)?, number(to)?)
            }
        };
        let percent = number(percent)?;
        let is_bound = |range_m: f64| BANDS_M.contains(&range_m);
        let is_range = is_bound(range_m.0) && is_bound(range_m.1) && range_m.0 < range_m.1;
        if layer.is_empty() || !(0.0..=100.0).contains(&percent) || !is_range {
            return Err(allowed());
        }
        Ok(Self { layer: layer.to_owned(), percent, range_m })
    }
}

impl fmt::Display for FootprintGate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}@{}-{}", self.layer, self.percent, self.range_m.0, self.range_m.1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gate_names_the_layer_the_share_and_the_range() {
        let gate: FootprintGate = "freespace=95@4-15".parse().unwrap();
        assert_eq!((gate.layer.as_str(), gate.percent, gate.range_m), ("freespace", 95.0, (4.0, 15.0)));
        assert_eq!("speed=0.5".parse::<FootprintGate>().unwrap().to_string(), "speed=0.5@4-20");
        for wrong in ["freespace", "=95", "a=101", "a=NaN", "a=-1", "a=95@4", "a=95@5-20", "a=95@20-4", "a=x"] {
            let error = wrong.parse::<FootprintGate>().unwrap_err();
            assert!(error.contains(&format!("{wrong:?}")) && error.contains("4, 8, 12"), "{error}");
        }
    }

    #[test]
    fn counts_pass_with_the_share_and_without_a_grave_footprint() {
        let gate: FootprintGate = "a=75@4-12".parse().unwrap();
        let mut tally = FootprintTally::default();
        assert!(gate.failure(&tally).unwrap().contains("no free footprint"));
        for answered in [true, true, true, false] {
            tally.level[1].add(answered);
        }
        assert_eq!(gate.failure(&tally), None);
        tally.level[3].add(false);
        tally.holding[1][4].add(true);
        assert_eq!(gate.failure(&tally), None, "other ranges do not count, nor 0.3 m beyond 20 m");
        tally.holding[1][0].add(true);
        assert!(gate.failure(&tally).unwrap().starts_with("1 footprint(s)"));
        tally.level[0].add(false);
        assert!(gate.failure(&tally).unwrap().starts_with("60.00 % of 5"));
    }
}
