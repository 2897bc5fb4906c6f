//! `clearway completions`: the name of a shell -> its completion script.

use anyhow::Result;
use clap::{Args, Command};
use clap_complete::Shell;

use crate::terminal::{Exit, print};

/// Print the completion script of a shell.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway completions bash > ~/.local/share/bash-completion/completions/clearway
  clearway completions zsh > ~/.zfunc/_clearway
  clearway completions fish > ~/.config/fish/completions/clearway.fish")]
pub struct CompletionsArguments {
    /// The shell.
    shell: Shell,
}

/// Prints the script that completes the subcommands and options of `command`.
pub fn run(options: &CompletionsArguments, mut command: Command) -> Result<Exit> {
    let mut script = Vec::new();
    clap_complete::generate(options.shell, &mut command, "clearway", &mut script);
    print(&String::from_utf8_lossy(&script))?;
    Ok(Exit::Good)
}
