//! The result of an evaluation as tables.

use std::fmt::Write as _;

use super::report::{PROTOCOLS, Report, Row, Source};
use super::tally::{BANDS, BANDS_M, Count, Tally};

/// Number of worlds that are listed for each layer, those with the most wrong cells first.
const WORST: usize = 5;

impl Report {
    /// The report as tables: one of all layers for the first row of each path, and one of all rows for each layer.
    pub fn to_text(&self) -> String {
        let mut text = String::new();
        // Writing into a string cannot fail.
        for source in &self.sources {
            let Some(first) = source.rows.first() else { continue };
            let unlabelled = match source.unlabelled {
                0 => String::new(),
                scans => format!("; {scans} scan(s) without labels left out"),
            };
            let _ = writeln!(text, "{}: {} frame(s){unlabelled}", source.path, first.frames);
            source.mounts.iter().for_each(|mount| _ = writeln!(text, "  extrinsics {mount}"));
            write_layers(&mut text, first);
            if source.rows.len() > 1 {
                write_rows(&mut text, source);
            }
            write_worst(&mut text, source);
        }
        let _ = writeln!(
            text,
            "A leak is a cell called drivable that has a point 0.3 to 2.5 m above the ground, or (simulated) ground \
             that is too steep or cannot be reached; free is the share of cells called drivable that have no such \
             point, reached or not. A false obstacle is a cell with ground and without such a point \
             that is called occupied; pure ground has no other points. Not reached: drivable cells whose class means \
             free ground without a way to it. Reach is the recall of all reachable ground; bands of range in metres \
             from the vehicle. The row ground is the shared estimate of the ground: a point within 0.2 m of it is \
             called ground."
        );
        PROTOCOLS.iter().for_each(|(name, words)| _ = writeln!(text, "{name}: {words}."));
        text
    }
}

/// All layers of one row.
fn write_layers(text: &mut String, row: &Row) {
    let _ = writeln!(
        text,
        "  {:<18} {:>37}  {:>7}  {:>15}  {:>7}  {:>29}  {:>29}",
        "",
        "drivable cells",
        "road",
        "false obstacles",
        "not",
        "ground points, vegetation",
        "ground points, low vegetation"
    );
    let _ = writeln!(
        text,
        "  {:<18} {:>9} {:>7} {:>9} {:>9}  {:>7}  {:>7} {:>7}  {:>7}  {:>29}  {:>29}",
        "map, %",
        "precision",
        "free",
        "reach",
        "F1",
        "recall",
        "ground",
        "pure",
        "reached",
        "excluded: P / R / F1",
        "is ground: P / R / F1"
    );
    for (layer, tally) in &row.layers {
        let [cells_p, cells_r, cells_f1] = [tally.precision(), tally.recall(), tally.f1()].map(percent);
        let [excluded, low] = tally.points.map(|points| {
            let [p, r, f1] = [points.precision(), points.recall(), points.f1()].map(percent);
            format!("{p} / {r} / {f1}")
        });
        let [free, road] = [tally.free_of_obstacles(), tally.road_recall()].map(percent);
        let [ground, pure, not_reached] =
            [tally.ground, tally.pure_ground, tally.not_reached].map(|count| percent(count.share()));
        let _ = writeln!(
            text,
            "  {layer:<18} {cells_p:>9} {free:>7} {cells_r:>9} {cells_f1:>9}  {road:>7}  {ground:>7} {pure:>7}  \
             {not_reached:>7}  {excluded:>29}  {low:>29}"
        );
    }
    for (layer, tally) in row.layers.iter().filter(|(_, tally)| tally.drivable.all > 0) {
        let _ = writeln!(text, "  reach of {layer} by range, %{:>width$}", bands(), width = 48 - layer.len());
        let _ = writeln!(text, "    {:<24} {}", "all", by_band(&tally.by_range));
        for (class, counts) in tally.by_class.iter().filter(|_| tally.by_class.len() > 1) {
            let _ = writeln!(text, "    {class:<24} {}", by_band(counts));
        }
    }
    for (layer, tally) in row.layers.iter().filter(|(_, tally)| tally.called > 0) {
        let _ = writeln!(text, "  leaks of {layer}: {}", leaks(tally));
    }
    for layer in &row.left_out {
        let _ = writeln!(text, "  {layer}: left out, because none of its classes is free");
    }
}

/// One table for each layer, one line for each row.
fn write_rows(text: &mut String, source: &Source) {
    let width = source.rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0).max(24) + 1;
    let layers: Vec<&str> = source.rows[0].layers.iter().map(|(name, _)| name.as_str()).collect();
    for layer in layers {
        let _ = writeln!(
            text,
            "  {:<width$} {:>6} {:>9} {:>6} {:>6} {:>6}  {:>6} {:>6} {:>6}  {:>6} {:>6}  {}  leaks",
            format!("{layer}, %"),
            "frames",
            "precision",
            "free",
            "reach",
            "road",
            "false",
            "pure",
            "not r.",
            "F1",
            "F1 veg",
            bands(),
        );
        for row in &source.rows {
            let Some(tally) = row.layer(layer) else { continue };
            let shares = [tally.precision(), tally.free_of_obstacles(), tally.recall(), tally.road_recall()];
            let [precision, free, reach, road] = shares.map(percent);
            let [ground, pure, not_reached] =
                [tally.ground, tally.pure_ground, tally.not_reached].map(|count| percent(count.share()));
            let [excluded, low] = tally.points.map(|points| percent(points.f1()));
            let name = format!("{}{}", row.name, if row.final_only { "*" } else { "" });
            let _ = writeln!(
                text,
                "  {name:<width$} {:>6} {precision:>9} {free:>6} {reach:>6} {road:>6}  {ground:>6} {pure:>6} \
                 {not_reached:>6}  {excluded:>6} {low:>6}  {}  {}",
                row.frames,
                by_band(&tally.by_range),
                leaks(tally)
            );
        }
    }
    if source.rows.iter().any(|row| row.final_only) {
        let _ = writeln!(text, "  * for final tables only: no parameter is tuned on these frames");
    }
    let times: Vec<String> = source.rows.iter().filter_map(Row::step_ms_p50).map(|ms| format!("{ms:.1}")).collect();
    if !times.is_empty() {
        let _ = writeln!(text, "  all maps, milliseconds a frame (p50), by row: {}", times.join(", "));
    }
}

/// The random worlds in which each layer has the most wrong cells.
fn write_worst(text: &mut String, source: &Source) {
    let Some(first) = source.rows.first().filter(|_| !source.worlds.is_empty()) else { return };
    for (layer, _) in &first.layers {
        let wrong = |world: &super::report::World| world.row.layer(layer).map_or(0, |tally| tally.called_wrongly);
        let mut worlds: Vec<_> = source.worlds.iter().filter(|world| wrong(world) > 0).collect();
        worlds.sort_by_key(|world| (std::cmp::Reverse(wrong(world)), world.seed));
        for world in worlds.into_iter().take(WORST) {
            let tally = world.row.layer(layer).map(leaks).unwrap_or_default();
            let (seed, name, description) = (world.seed, &world.name, &world.description);
            let _ = writeln!(text, "  worst of {layer}: seed {seed} ({name}): {tally}: {description}");
        }
    }
}

fn leaks(tally: &Tally) -> String {
    let by_class: Vec<String> = tally.leaks.iter().map(|(class, cells)| format!("{class} {cells}")).collect();
    let by_class = if by_class.is_empty() { "none".to_owned() } else { by_class.join(", ") };
    let by_range: Vec<String> = tally.wrong_by_range.iter().map(|count| count.of_them.to_string()).collect();
    let by_range =
        if tally.called_wrongly == 0 { String::new() } else { format!("; by range {}", by_range.join(", ")) };
    format!("{} of {} drivable cells: {by_class}{by_range}", tally.called_wrongly, tally.called)
}

fn bands() -> String {
    let names: Vec<String> =
        BANDS_M.windows(2).map(|pair| format!("{:>6}", format!("{}-{}", pair[0], pair[1]))).collect();
    names.join(" ")
}

fn by_band(counts: &[Count; BANDS]) -> String {
    let shares: Vec<String> = counts.iter().map(|count| format!("{:>6}", percent(count.share()))).collect();
    shares.join(" ")
}

fn percent(share: Option<f64>) -> String {
    share.map_or("-".into(), |share| format!("{:.2}", 100.0 * share))
}
