//! The command `clearway`.

use std::process::ExitCode;

fn main() -> ExitCode {
    clearway::cli::main()
}
