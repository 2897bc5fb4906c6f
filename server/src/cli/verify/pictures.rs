//! The maps that changed most -> pictures: before, after, and what changed, side by side.

use std::path::Path;

use anyhow::Result;

use super::checked::{Checked, Outcome};
use crate::cli::shared::files;
use clearway_daemon::encode::picture::{self, Picture, Style};
use clearway_journal::compare::MapChange;

/// Edge of each of the three maps, in pixels; ours, because three of them fit a screen.
const PIXELS: u32 = 480;

/// Draws the maps of a result that changed most into `folder`, and adds the files to the result.
///
/// # Errors
/// If a file cannot be written.
pub fn draw(result: &mut Checked, folder: &Path) -> Result<()> {
    let Outcome::Compared(comparison) = &result.outcome else { return Ok(()) };
    let stem = stem(&result.file);
    for map in &comparison.worst {
        let file = folder.join(format!("{stem}_{:06}_{}_{}.png", map.sequence, map.vehicle, map.after.name));
        files::write_new(&file, &before_after_change(map)?.to_png()?)?;
        result.pictures.push(file);
    }
    Ok(())
}

/// The path of a recording as the beginning of a file's name. One that begins with a dot would be hidden.
fn stem(recording: &Path) -> String {
    let name = recording.with_extension("").display().to_string().replace(['/', '\\'], "_");
    name.trim_start_matches(['.', '_']).to_owned()
}

fn before_after_change(map: &MapChange) -> Result<Picture> {
    let style = |caption: String| Style { pixels: PIXELS, caption: vec![caption], ..Style::default() };
    let title = |side| format!("{} {} {}: {side}", map.vehicle, map.after.name, map.sequence);
    let change =
        format!("{:.2} % changed, {:.1} m2 gained, {:.1} m2 lost", 100.0 * map.share(), map.gained_m2, map.lost_m2);
    Ok(Picture::sheet(
        &[
            picture::of_layer(&map.before, &style(title("before")))?,
            picture::of_layer(&map.after, &style(title("after")))?,
            picture::of_change(&map.before, &map.after, &style(change)),
        ],
        3,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_picture_is_hidden() {
        let names = ["drives/a.mcap", "../drives/a.mcap", "/data/../a.mcap"].map(|file| stem(Path::new(file)));
        assert_eq!(names, ["drives_a", "drives_a", "data_.._a"]);
    }
}
