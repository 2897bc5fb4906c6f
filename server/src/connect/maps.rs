//! The options that name maps -> a stream of them.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Result, bail};
use clap::Args;
use clearway_client::{ClientError, MapStream, Subscription};
#[cfg(feature = "zenoh")]
use clearway_daemon::base::files;

use super::server::{ServerOptions, explain};
use crate::terminal::with_causes;

/// Time after which a server that does not answer is named, and asked again.
const ASK_PERIOD: Duration = Duration::from_secs(1);
/// The layer that is read over zenoh if none is named.
#[cfg(feature = "zenoh")]
const DEFAULT_LAYER: &str = "freespace";

/// The options that name the maps to read, and from where.
#[derive(Args)]
pub struct MapOptions {
    #[command(flatten)]
    server: ServerOptions,
    /// Read over zenoh instead of gRPC, from this endpoint, such as tcp/localhost:7447; or, with
    /// certificates, tls/HOST:7447.
    #[arg(long, value_name = "ENDPOINT", conflicts_with = "address")]
    zenoh: Option<String>,
    /// Believe only maps that are signed with the private key of this public key (`zenoh.signing_key` of the server).
    #[arg(long, value_name = "FILE.pub", requires = "zenoh")]
    signed_by: Option<PathBuf>,
    /// The vehicle, if the server has several.
    #[arg(long, value_name = "NAME")]
    pub vehicle: Option<String>,
    /// Layers, separated by commas; all if absent. Over zenoh one layer; freespace if absent.
    #[arg(long, alias = "layer", value_name = "LAYER", value_delimiter = ',')]
    layers: Vec<String>,
    /// Greatest number of maps a second; every map if absent.
    #[arg(long, value_name = "HZ", conflicts_with = "zenoh")]
    max_rate_hz: Option<f64>,
}

impl MapOptions {
    /// Subscribes; an endless stream waits until a server answers, and reconnects.
    ///
    /// # Errors
    /// [`ClientError`] if the server refuses or does not answer; if no vehicle or several ones are there over zenoh.
    pub async fn subscribe(&self, is_endless: bool) -> Result<MapStream> {
        let mut said = String::new();
        loop {
            let error = match self.subscribe_once(is_endless).await {
                Ok(maps) => return Ok(maps),
                Err(error) => error,
            };
            let is_away = matches!(error.downcast_ref(), Some(ClientError::Unreachable { .. }));
            if !is_away || !is_endless {
                return Err(error);
            }
            let text = with_causes(&error);
            if text != said {
                eprintln!("clearway: {text}; waiting for it");
                said = text;
            }
            tokio::time::sleep(ASK_PERIOD).await;
        }
    }

    async fn subscribe_once(&self, is_endless: bool) -> Result<MapStream> {
        if let Some(endpoint) = &self.zenoh {
            return self.subscribe_over_zenoh(endpoint).await;
        }
        let subscription = Subscription {
            vehicle: self.vehicle.clone().unwrap_or_default(),
            layers: self.layers.clone(),
            max_rate_hz: self.max_rate_hz,
            reconnects: is_endless,
            ..Subscription::default()
        };
        self.server.connect().await?.subscribe(subscription).await.map_err(explain)
    }

    #[cfg(feature = "zenoh")]
    async fn subscribe_over_zenoh(&self, endpoint: &str) -> Result<MapStream> {
        let layer = match &self.layers[..] {
            [] => DEFAULT_LAYER,
            [layer] => layer,
            several => bail!("--layers {}: over zenoh each layer has its own key; name one", several.join(",")),
        };
        let mut connecting = std::pin::pin!(self.server.connect_over_zenoh(endpoint));
        let mut client = match tokio::time::timeout(ASK_PERIOD, &mut connecting).await {
            Ok(connected) => connected?,
            Err(_) => {
                eprintln!("clearway: {endpoint} does not answer yet");
                connecting.await?
            }
        };
        if let Some(file) = &self.signed_by {
            client = client.signed_by(clearway_client::PublicKey::from_pem(&files::read_text(file)?)?);
        }
        let vehicle = match (&self.vehicle, &client.vehicles().await?[..]) {
            (Some(name), present) => {
                if !present.contains(name) {
                    let others = if present.is_empty() { "none" } else { &present.join(", ") };
                    eprintln!(
                        "clearway: --vehicle {name}: no server at {endpoint} publishes it now (others: {others})"
                    );
                }
                name.clone()
            }
            (None, []) => bail!("no server at {endpoint} publishes a vehicle"),
            (None, [only]) => only.clone(),
            (None, several) => bail!("{endpoint} has {}: name one with --vehicle", several.join(", ")),
        };
        Ok(client.subscribe(&vehicle, layer).await?)
    }

    #[cfg(not(feature = "zenoh"))]
    async fn subscribe_over_zenoh(&self, endpoint: &str) -> Result<MapStream> {
        bail!("--zenoh {endpoint}: this clearway was built without the feature zenoh")
    }
}
