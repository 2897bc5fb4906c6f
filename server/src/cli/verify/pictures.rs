//! The maps that changed most -> pictures: before, after, and what changed, side by side.

use std::path::Path;

use anyhow::Result;

use super::checked::{Checked, Outcome};
use crate::cli::shared::files;
use clearway_tools::picture::change::before_after_change;

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_picture_is_hidden() {
        let names = ["drives/a.mcap", "../drives/a.mcap", "/data/../a.mcap"].map(|file| stem(Path::new(file)));
        assert_eq!(names, ["drives_a", "drives_a", "data_.._a"]);
    }
}
