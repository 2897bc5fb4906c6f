//! The result of an evaluation as tables.

use std::fmt::Write as _;

use super::footprint::tally as footprint_tally;
use super::report::{EvaluatedRow, EvaluatedSource, Evaluation, PROTOCOLS};
use super::tally::{BANDS, BANDS_M, CellCount, Tally};

/// Number of worlds that are listed for each layer, worlds with the most wrong cells first.
const WORST: usize = 5;

impl Evaluation {
    /// The result as tables: one for each layer of each path.
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
            write_layers(&mut text, source, first);
            write_footprints(&mut text, source);
            write_objects(&mut text, source);
            write_worst(&mut text, source);
        }
        let _ = writeln!(
            text,
            "A leak is a cell called drivable that has a point 0.3 to 2.5 m above the ground, or (simulated) ground \
             that is too steep or cannot be reached; free is the share of cells called drivable that have no such \
             point, reached or not. A false obstacle is a cell with ground and without such a point \
             that is called occupied; pure ground has no other points. Not reached: drivable cells whose class means \
             free ground without a way to it. Reach is the recall of all reachable ground; bands of range in metres \
             from the vehicle. The layer ground is the shared estimate of the ground: a point within 0.2 m of it is \
             called ground. F1 gr. and F1 veg: F1 of ground points by the two protocols below. A footprint is 4 m by \
             2 m. Of the footprints on one level that the truth calls free, the table has the share that the layer \
             answers free, by range in metres; stepped are footprints across a kerb, at 4 to 20 m. Then of the \
             footprints in which something stands those answered free, by the height of the highest thing; grave are \
             those of 0.5 m, or of 0.3 m within 20 m. Refused by: the classes of the cells that forbid free footprints."
        );
        PROTOCOLS.iter().for_each(|(name, words)| _ = writeln!(text, "{name}: {words}."));
        text
    }
}

/// A table for each layer, with one line for each row; then the reach of the first row by class of ground.
fn write_layers(text: &mut String, source: &EvaluatedSource, first: &EvaluatedRow) {
    let width = source.rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0).max(26) + 1;
    for (layer, first) in &first.layers {
        let _ = writeln!(
            text,
            "  {:<width$} frames precision   free  reach     F1   road  false   pure not r.  F1 gr. F1 veg  {}  leaks",
            format!("{layer}, %"),
            bands(),
        );
        for row in &source.rows {
            let Some(tally) = row.layer(layer) else { continue };
            let [precision, free, reach, f1, road] =
                [tally.precision(), tally.free_of_obstacles(), tally.recall(), tally.f1(), tally.road_recall()]
                    .map(percent);
            let [ground, pure, not_reached] =
                [tally.ground, tally.pure_ground, tally.not_reached].map(|count| percent(count.share()));
            let [excluded, low] = tally.points.map(|points| percent(points.f1()));
            let name = format!("{}{}", row.name, if row.final_only { "*" } else { "" });
            let _ = writeln!(
                text,
                "  {name:<width$} {:>6} {precision:>9} {free:>6} {reach:>6} {f1:>6} {road:>6} {ground:>6} {pure:>6} \
                 {not_reached:>6}  {excluded:>6} {low:>6}  {}  {}",
                row.frames,
                by_band(&tally.by_range),
                leaks(tally)
            );
        }
        for (class, counts) in first.by_class.iter().filter(|_| first.by_class.len() > 1) {
            let _ = writeln!(
                text,
                "  {:<offset$}  {}",
                format!("  reach of {class}"),
                by_band(counts),
                offset = width + 81
            );
        }
    }
    for layer in &first.left_out {
        let _ = writeln!(text, "  {layer}: left out, because none of its classes is free");
    }
    if source.rows.iter().any(|row| row.final_only) {
        let _ = writeln!(text, "  * for final tables only: no parameter is tuned on these frames");
    }
    let times: Vec<String> =
        source.rows.iter().filter_map(EvaluatedRow::step_ms_p50).map(|ms| format!("{ms:.1}")).collect();
    if !times.is_empty() {
        let _ = writeln!(text, "  all maps, milliseconds a frame (p50), by row: {}", times.join(", "));
    }
}

/// A line for each layer and row: how whole footprints are answered.
fn write_footprints(text: &mut String, source: &EvaluatedSource) {
    let width = source.rows.iter().map(|row| row.name.chars().count()).max().unwrap_or(0).max(12) + 20;
    let names: Vec<String> =
        footprint_tally::BANDS_M.windows(2).map(|pair| format!("{}-{}", pair[0], pair[1])).collect();
    let names: String = names.iter().map(|name| format!("{name:>7}")).collect();
    let _ = writeln!(
        text,
        "  {:<width$}{names}   4-20     n  stepped | free with a thing of 0.2, 0.3, 0.5 m; grave | unreachable | refused by",
        "footprints answered free, %"
    );
    for (row, (layer, tally)) in source.rows.iter().flat_map(|row| row.footprints.iter().map(move |of| (row, of))) {
        let bands: String = tally.level.iter().map(|count| format!("{:>7}", percent(count.share()))).collect();
        let near = tally.level_within(4.0, 20.0);
        let all = |bands: &footprint_tally::Bands| {
            let sum = footprint_tally::within(bands, 4.0, 30.0);
            format!("{}/{}", sum.of_them, sum.all)
        };
        let stepped = footprint_tally::within(&tally.stepped, 4.0, 20.0);
        let refused: Vec<String> = tally.refused.iter().map(|(class, number)| format!("{class} {number}")).collect();
        let holding = tally.holding.each_ref().map(all).join(", ");
        let _ = writeln!(
            text,
            "  {:<width$}{bands} {:>6} {:>5} {:>8} | {holding}; {} | {} | {}",
            format!("{layer} {}", row.name),
            percent(near.share()),
            near.all,
            percent(stepped.share()),
            tally.grave(),
            all(&tally.unreachable),
            refused.join(", ")
        );
    }
}

/// A line for each object and distance: the cells with the object in them that each layer calls free, of all.
fn write_objects(text: &mut String, source: &EvaluatedSource) {
    for (index, ((object, distance_m), layers)) in source.objects.iter().enumerate() {
        let of_layer = |(layer, count): &(String, CellCount)| format!("{layer} {}/{}", count.of_them, count.all);
        let counts: Vec<String> = layers.iter().map(of_layer).collect();
        let title = if index == 0 { "  free cells of objects cut into the scans\n" } else { "" };
        let _ = writeln!(text, "{title}    {:<26} {}", format!("{object} at {distance_m} m"), counts.join(", "));
    }
}

/// The random worlds in which each layer has the most wrong cells.
fn write_worst(text: &mut String, source: &EvaluatedSource) {
    let Some(first) = source.rows.first().filter(|_| !source.worlds.is_empty()) else { return };
    for (layer, _) in &first.layers {
        let wrong =
            |world: &super::report::EvaluatedWorld| world.row.layer(layer).map_or(0, |tally| tally.called_wrongly);
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

fn by_band(counts: &[CellCount; BANDS]) -> String {
    let shares: Vec<String> = counts.iter().map(|count| format!("{:>6}", percent(count.share()))).collect();
    shares.join(" ")
}

fn percent(share: Option<f64>) -> String {
    share.map_or("-".into(), |share| format!("{:.2}", 100.0 * share))
}
