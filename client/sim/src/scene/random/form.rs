//! The forms of the ground in random worlds: level, graded, over a crest, through a dip, banked, rolling.
//!
//! In: random numbers. Out: a profile along the road (x) and one across it (y), and a description. The road runs along
//! x, and the vehicle stands at x = 0.

use std::f64::consts::TAU;

use super::super::ground::Profile;
use super::draw::Draw;

/// Form of the ground, before kerbs and ditches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Form {
    /// Level along the road, with the fall to its sides that drains a road.
    Level,
    /// Level ground that passes over to a steady grade of up to 15 %.
    Grade,
    /// A grade that rises to a crest and falls behind it.
    Crest,
    /// A grade that falls to a dip and rises behind it.
    Dip,
    /// A road that is banked by up to 10 %, on a grade of up to 6 %.
    Banked,
    /// Waves along the road with grades of up to 15 %.
    Rolling,
}

impl Form {
    /// All forms, in the order of the enum.
    pub const ALL: [Self; 6] = [Self::Level, Self::Grade, Self::Crest, Self::Dip, Self::Banked, Self::Rolling];

    /// Name of the form, as `evaluate` prints it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Level => "level",
            Self::Grade => "grade",
            Self::Crest => "crest",
            Self::Dip => "dip",
            Self::Banked => "banked",
            Self::Rolling => "rolling",
        }
    }

    /// The profiles along and across the road, and a description.
    pub(super) fn draw(self, draw: &mut Draw) -> (Profile, Profile, String) {
        let crown = draw.between(0.0, 0.025);
        let drained = Profile::through(&[(-12.0, -12.0 * crown), (0.0, 0.0), (12.0, -12.0 * crown)]);
        match self {
            Self::Level => (Profile::default(), drained, format!("level, crown {:.1} %", 100.0 * crown)),
            Self::Grade => {
                let (grade, from, length) =
                    (draw.sign() * draw.between(0.03, 0.15), draw.between(-10.0, 30.0), draw.between(6.0, 20.0));
                let along = integral(&[(from, 0.0), (from + length, grade)]);
                (along, drained, format!("grade {:.1} % from x = {from:.0} m", 100.0 * grade))
            }
            Self::Crest | Self::Dip => {
                let (top, length) = (draw.between(-10.0, 35.0), draw.between(8.0, 25.0));
                let sign = if self == Self::Crest { 1.0 } else { -1.0 };
                let grades = [draw.between(0.03, 0.15) * sign, -draw.between(0.03, 0.15) * sign];
                let along = integral(&[(top - length / 2.0, grades[0]), (top + length / 2.0, grades[1])]);
                let [before, behind] = grades.map(|grade| 100.0 * grade);
                (along, drained, format!("{} {before:.1} / {behind:.1} % at x = {top:.0} m", self.name()))
            }
            Self::Banked => {
                let (bank, half) = (draw.sign() * draw.between(0.02, 0.10), draw.between(6.0, 14.0));
                let grade = draw.between(-0.06, 0.06);
                let along = integral(&[(0.0, grade)]);
                let across = Profile::through(&[
                    (-half - 3.0, -bank * (half + 1.5)),
                    (-half, -bank * half),
                    (half, bank * half),
                    (half + 3.0, bank * (half + 1.5)),
                ]);
                (along, across, format!("banked {:.1} %, grade {:.1} %", 100.0 * bank, 100.0 * grade))
            }
            Self::Rolling => {
                let (grade, wave) = (draw.between(0.04, 0.15), draw.between(30.0, 70.0));
                let phase = draw.between(0.0, TAU);
                // Sixteen stretches to a wave, so that neighbours differ by at most 6 %.
                let knots = (-64..=64).map(|step| f64::from(step) * wave / 16.0);
                let knots: Vec<_> = knots.map(|place| (place, grade * (TAU * place / wave + phase).sin())).collect();
                (integral(&knots), drained, format!("rolling {:.1} %, waves of {wave:.0} m", 100.0 * grade))
            }
        }
    }
}

/// Distance from the vehicle at which the ground's profiles end, in metres: beyond the range of the sensors.
const END_M: f64 = 160.0;
/// Length of a straight stretch where the grade changes, in metres. Ours, because a grade that changes by 30 % over
/// 8 m, the sharpest crest, then bends by less than 6 % from stretch to stretch.
const STRETCH_M: f64 = 1.5;

/// The heights of a road whose grade is linear between the knots (place, grade), and constant beyond them.
fn integral(knots: &[(f64, f64)]) -> Profile {
    let first = knots[0];
    let mut points = vec![(first.0.min(-END_M), 0.0)];
    let mut advance = |to: f64, grade: f64| {
        let (place, height) = points[points.len() - 1];
        if to > place {
            points.push((to, height + grade * (to - place)));
        }
    };
    advance(first.0, first.1);
    for pair in knots.windows(2) {
        let ((from, before), (to, behind)) = (pair[0], pair[1]);
        let stretches = ((to - from) / STRETCH_M).ceil().max(1.0);
        for stretch in 0..stretches as u32 {
            let share = (f64::from(stretch) + 0.5) / stretches;
            let end = from + (to - from) * (f64::from(stretch) + 1.0) / stretches;
            advance(end, before + share * (behind - before));
        }
    }
    let last = knots[knots.len() - 1];
    advance(END_M.max(last.0 + 1.0), last.1);
    Profile::through(&points)
}

#[cfg(test)]
mod tests {
    use super::super::super::ground::Ground;
    use super::*;

    #[test]
    fn a_road_has_the_grades_of_its_knots() {
        let ground = Ground { along: integral(&[(10.0, 0.0), (20.0, 0.15)]), ..Ground::default() };
        assert_eq!([ground.slope(-5.0, 0.0), ground.slope(9.0, 0.0)], [0.0, 0.0]);
        assert!((ground.slope(60.0, 0.0) - 0.15).abs() < 1e-9);
        assert!((ground.height(20.0, 0.0) - ground.height(10.0, 0.0) - 0.75).abs() < 1e-9);
    }

    #[test]
    fn no_form_is_steeper_than_it_may_be() {
        for seed in 0..600 {
            let form = Form::ALL[seed as usize % 6];
            let (along, across, text) = form.draw(&mut Draw::new(seed));
            let ground = Ground { along, across, ..Ground::default() };
            for step in -1000..1000 {
                let slope = ground.slope(f64::from(step) * 0.1, f64::from(step % 90) * 0.2);
                assert!(slope < 0.16, "seed {seed}, {text}: {slope}");
            }
        }
    }
}
