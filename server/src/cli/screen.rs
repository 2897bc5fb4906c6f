//! Lines of text that replace the ones before on a terminal, and follow them elsewhere.

use anyhow::Result;
use console::Term;

use crate::cli::shared::output::print;

/// Rows and columns where stdout is no terminal.
const SIZE: (usize, usize) = (50, 120);

/// Stdout, as a screen.
pub struct Screen(Term);

impl Screen {
    /// The screen of this process.
    pub fn new() -> Self {
        Self(Term::stdout())
    }

    /// True if stdout is a terminal.
    pub fn is_live(&self) -> bool {
        self.0.is_term()
    }

    /// Number of rows that [`Screen::show`] can show, and number of columns.
    pub fn size(&self) -> (usize, usize) {
        if !self.is_live() {
            return SIZE;
        }
        let (rows, columns) = self.0.size();
        // The last row stays free, so that the terminal does not scroll.
        (usize::from(rows).saturating_sub(1), columns.into())
    }

    /// Shows `lines` in place of those before; elsewhere than on a terminal an empty line follows them. `false` if the
    /// reader of stdout has closed it.
    ///
    /// # Errors
    /// If stdout cannot be written.
    pub fn show(&self, lines: &[String]) -> Result<bool> {
        if !self.is_live() {
            return print(&format!("{}\n\n", lines.join("\n")));
        }
        let lines = &lines[..lines.len().min(self.size().0)];
        let text: String = lines.iter().map(|line| format!("{line}\x1b[K\r\n")).collect();
        self.0.move_cursor_to(0, 0)?;
        self.0.write_str(&text)?;
        self.0.clear_to_end_of_screen()?;
        Ok(true)
    }

    /// Hides the cursor of a terminal, or shows it again.
    ///
    /// # Errors
    /// If the terminal cannot be written.
    pub fn set_cursor(&self, is_visible: bool) -> Result<()> {
        if self.is_live() && is_visible {
            self.0.show_cursor()?;
        } else if self.is_live() {
            self.0.hide_cursor()?;
        }
        Ok(())
    }
}
