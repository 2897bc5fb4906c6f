//! Metrics -> Prometheus' text format 0.0.4.

use std::fmt::Write as _;

use super::histogram::Histogram;

/// The content type of the format.
pub const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// The labels of one sample.
type Labels = Vec<(&'static str, String)>;

/// A text of metrics. Writing to a string cannot fail.
#[derive(Debug, Default)]
pub(super) struct TextFormat(String);

impl TextFormat {
    /// The text of all metrics so far.
    pub fn into_text(self) -> String {
        self.0
    }

    /// Writes one metric with its samples: a counter if its name ends in `_total`, else a gauge. Without samples it is
    /// left out.
    pub fn family(&mut self, name: &str, help: &str, samples: impl IntoIterator<Item = (Labels, f64)>) {
        let kind = if name.ends_with("_total") { "counter" } else { "gauge" };
        let mut samples = samples.into_iter().peekable();
        if samples.peek().is_some() {
            self.head(name, help, kind);
        }
        samples.for_each(|(labels, value)| self.sample(name, &labels, value));
    }

    /// Writes one histogram for each of these labels, in seconds.
    pub fn histogram<'a>(
        &mut self,
        name: &str,
        help: &str,
        samples: impl IntoIterator<Item = (Labels, &'a Histogram)>,
    ) {
        self.head(name, help, "histogram");
        for (mut labels, times) in samples {
            self.sample(&format!("{name}_sum"), &labels, times.sum_s());
            self.sample(&format!("{name}_count"), &labels, times.count() as f64);
            labels.push(("le", String::new()));
            for (bound_s, count) in times.up_to_bounds() {
                let bound = if bound_s.is_finite() { format!("{bound_s:?}") } else { "+Inf".to_owned() };
                labels.last_mut().into_iter().for_each(|(_, value)| value.clone_from(&bound));
                self.sample(&format!("{name}_bucket"), &labels, count as f64);
            }
        }
    }

    fn head(&mut self, name: &str, help: &str, kind: &str) {
        let _ = writeln!(self.0, "# HELP {name} {help}\n# TYPE {name} {kind}");
    }

    fn sample(&mut self, name: &str, labels: &Labels, value: f64) {
        let escaped = |text: &str| text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
        let labels: Vec<_> = labels.iter().map(|(label, of)| format!("{label}=\"{}\"", escaped(of))).collect();
        let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        let _ = writeln!(self.0, "{name}{labels} {value}");
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_name_is_escaped_and_the_buckets_of_a_histogram_are_cumulative() {
        let mut text = TextFormat::default();
        let label = |value: &str| vec![("vehicle", value.to_owned())];
        text.family("cars_total", "Cars.", [(label("a\"b\\c\nd"), 3.0), (vec![], 0.25)]);
        text.family("vans", "Vans.", []);
        let mut times = Histogram::default();
        [0.3, 1.5, 70_000.0].iter().for_each(|ms| times.observe(Duration::from_secs_f64(ms / 1e3)));
        text.histogram("age_seconds", "Age.", [(label("car"), &times)]);
        let text = text.into_text();
        let cars = "# HELP cars_total Cars.\n# TYPE cars_total counter\ncars_total{vehicle=\"a\\\"b\\\\c\\nd\"} 3\n\
                    cars_total 0.25\n# HELP age_seconds";
        assert!(text.starts_with(cars), "{text}");
        let bucket = |bound, count| format!("age_seconds_bucket{{vehicle=\"car\",le=\"{bound}\"}} {count}\n");
        for line in [bucket("0.0005", 1), bucket("0.001", 1), bucket("1.0", 2), bucket("60.0", 2), bucket("+Inf", 3)] {
            assert!(text.contains(&line), "{line}{text}");
        }
        assert!(text.contains("age_seconds_count{vehicle=\"car\"} 3\n"), "{text}");
    }
}
