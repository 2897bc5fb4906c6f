//! `clearway top`: a server -> a live table of the vehicles of the server and of the servers it knows, the worst first.

use anyhow::Result;
use clap::Args;
use clearway_client::{Client, v1};
use futures::StreamExt;

use crate::connect::{ServerOptions, explain};
use crate::process::stop_signal;
use crate::terminal::{Exit, Screen};
use crate::vehicles::table::{table, with_others};

/// Show the vehicles of a fleet live: state, age, rate, loss, latency, readers, and what is wrong.
///
/// It lists the vehicles of the server and of the servers it knows, which announce theirs once a second.
/// The table is renewed once a second and whenever a state changes, the worst vehicle first; Ctrl-C ends it. If stdout
/// is not a terminal, each table follows the one before.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway top
  clearway top car truck --server fleet.local:50051
  clearway top --count 1")]
pub struct TopArguments {
    #[command(flatten)]
    server: ServerOptions,
    /// The vehicles; all if absent.
    #[arg(value_name = "VEHICLE")]
    vehicles: Vec<String>,
    /// End after this many tables; at Ctrl-C if absent.
    #[arg(long, value_name = "TABLES")]
    count: Option<u64>,
}

/// Shows tables until Ctrl-C, the count is reached, or the reader of stdout has closed it.
pub async fn run(options: &TopArguments) -> Result<Exit> {
    let screen = Screen::new();
    screen.set_cursor(false)?;
    let ended = show(options, &screen).await;
    screen.set_cursor(true)?;
    ended.map(|()| Exit::Good)
}

async fn show(options: &TopArguments, screen: &Screen) -> Result<()> {
    let stop = stop_signal()?;
    let client = options.server.connect().await?;
    let mut updates = client.watch_status(&[]).await.map_err(explain)?;
    let mut shown = 0;
    tokio::pin!(stop);
    while options.count.is_none_or(|count| shown < count) {
        let update = tokio::select! {
            () = &mut stop => break,
            update = updates.next() => update,
        };
        let Some(update) = update else { break };
        let own = update.map_err(explain)?;
        let vehicles = with_others(own, client.vehicles().await.map_err(explain)?, &options.vehicles);
        if shown == 0 {
            check(&client, &vehicles, &options.vehicles).await?;
        }
        if !screen.show(&table(vehicles, screen.columns(), screen.is_coloured()))? {
            break;
        }
        shown += 1;
    }
    Ok(())
}

/// Checks that there is a vehicle of each name; if not, the server says why.
async fn check(client: &Client, vehicles: &[v1::Vehicle], names: &[String]) -> Result<()> {
    let is_missing = |name: &&String| !vehicles.iter().any(|vehicle| vehicle.name == **name);
    let missing: Vec<_> = names.iter().filter(is_missing).cloned().collect();
    if !missing.is_empty() {
        drop(client.watch_status(&missing).await.map_err(explain)?);
    }
    Ok(())
}
