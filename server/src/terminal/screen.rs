//! Stdout, as a screen that is drawn again and again.

use anyhow::Result;
use console::Term;

use super::output::print;

/// Columns where stdout is no terminal.
const COLUMNS: usize = 120;

/// Stdout, as a screen.
pub struct Screen(Term);

impl Screen {
    /// The screen of this process.
    pub fn new() -> Self {
        Self(Term::stdout())
    }

    /// True if stdout is a terminal with colours and `NO_COLOR` is not set.
    pub fn is_coloured(&self) -> bool {
        self.0.features().colors_supported()
    }

    /// Number of columns.
    pub fn columns(&self) -> usize {
        if self.0.is_term() { self.0.size().1.into() } else { COLUMNS }
    }

    /// Shows `lines` in place of the lines before; elsewhere than on a terminal an empty line follows them. `false` if
    /// the reader of stdout has closed it.
    pub fn show(&self, lines: &[String]) -> Result<bool> {
        if !self.0.is_term() {
            return print(&format!("{}\n\n", lines.join("\n")));
        }
        // The last row stays free, so that the terminal does not scroll.
        let rows = usize::from(self.0.size().0).saturating_sub(1);
        let text: String = lines.iter().take(rows).map(|line| format!("{line}\x1b[K\r\n")).collect();
        self.0.move_cursor_to(0, 0)?;
        self.0.write_str(&text)?;
        self.0.clear_to_end_of_screen()?;
        Ok(true)
    }

    /// Hides the cursor of a terminal, or shows it again.
    pub fn set_cursor(&self, is_visible: bool) -> Result<()> {
        if self.0.is_term() && is_visible {
            self.0.show_cursor()?;
        } else if self.0.is_term() {
            self.0.hide_cursor()?;
        }
        Ok(())
    }
}
