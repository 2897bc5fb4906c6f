//! The subcommands that never run on a vehicle: a build without the feature `tools` does not have them.

use anyhow::Result;
use clap::Subcommand;

use super::shared::exit::Exit;
use super::{demo, evaluate, export, get, init, send, simulate};

/// The subcommands, in the order of the help text.
#[derive(Subcommand)]
pub enum ToolCommand {
    Demo(demo::DemoArguments),
    Evaluate(evaluate::EvaluateArguments),
    Init(init::InitArguments),
    Get(get::GetArguments),
    Export(export::ExportArguments),
    Send(send::SendArguments),
    Simulate(simulate::SimulateArguments),
}

/// Runs a subcommand.
///
/// # Errors
/// The errors of the subcommand.
pub fn run(command: ToolCommand) -> Result<Exit> {
    match command {
        ToolCommand::Demo(arguments) => demo::run(arguments)?,
        ToolCommand::Evaluate(arguments) => return evaluate::run(arguments),
        ToolCommand::Init(arguments) => init::run(arguments)?,
        ToolCommand::Get(options) => return get::run(&options),
        ToolCommand::Export(arguments) => return export::run(arguments),
        ToolCommand::Send(arguments) => return send::run(arguments),
        ToolCommand::Simulate(arguments) => simulate::run(&arguments)?,
    }
    Ok(Exit::Good)
}
