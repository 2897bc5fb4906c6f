//! The zenoh session that ingest and publishers share: its settings, its limits, its errors.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use zenoh::bytes::Encoding;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::session::ZenohId;
use zenoh::{Config, Session};

use crate::base::token_bucket::TokenBucket;
use crate::config::{Zenoh as Options, ZenohMode};

/// What one peer may cost: zenoh's setting, value in JSON5. A file named in `[zenoh]` has its own values; the files in
/// `deploy/zenoh` have these. All values are ours, for the reasons beside them.
const LIMITS: [(&str, &str); 12] = [
    // A thousand readers, and the vehicles.
    ("transport/unicast/max_sessions", "1024"),
    // Handshakes at a time; a peer that opens a connection and stays silent loses it after 3 s. zenoh has no limit for
    // one address, so there are many places.
    ("transport/unicast/accept_pending", "1000"),
    ("transport/unicast/accept_timeout", "3000"),
    // A peer behind a repaired link, or a restarted router, has the maps again within 2 s: the kernel repeats the first
    // packet of a connection after 1 s and then only after 3 s, so that a new attempt is sooner.
    ("transport/unicast/open_timeout", "2000"),
    ("connect/retry", "{ period_init_ms: 100, period_max_ms: 500, period_increase_factor: 2 }"),
    // A peer that disappears silently (a pulled cable) is noticed after 2 s; a live one sends four keep-alive
    // messages in that time.
    ("transport/link/tx/lease", "2000"),
    ("transport/link/tx/keep_alive", "4"),
    // Batches of 64 KiB in the queue of the maps, allocated when needed. Eight hold all layers of several maps, so that
    // a short delay of the machine drops nothing. No more than this, and what the kernel holds, waits for a stopped
    // peer.
    ("transport/link/tx/queue/size", "{ interactive_high: 8 }"),
    ("transport/link/tcp", "{ so_sndbuf: 262144 }"),
    ("transport/link/tls/so_sndbuf", "262144"),
    // In us. A sender waits once for a congested peer; afterwards it drops that peer's maps at once, until the peer
    // receives again.
    ("transport/link/tx/queue/congestion_control/drop", "{ wait_before_drop: 1000 }"),
    // In us. A message that may not be dropped (a declaration, some replies) waits this long; then the connection ends.
    ("transport/link/tx/queue/congestion_control/block", "{ wait_before_close: 1000000 }"),
];
/// The longest message of a peer, in bytes, unless observations may be longer. zenoh drops a longer message before it
/// is assembled; a shorter message that is still too long is refused with a reason.
const MESSAGE_BYTES_MAX: usize = 64 << 20;

/// An operation on the zenoh session failed.
#[derive(Debug, thiserror::Error)]
#[error("zenoh: {what}: {reason}")]
pub struct ZenohError {
    /// The operation, with the key or setting.
    what: String,
    /// The reason that zenoh gives, without the places in its source.
    reason: String,
}

/// Files in the configuration of zenoh, under `transport/link/tls`.
const CERTIFICATE_FILES: [&str; 5] =
    ["root_ca_certificate", "listen_certificate", "listen_private_key", "connect_certificate", "connect_private_key"];

impl ZenohError {
    /// For `map_err`: names the operation that zenoh's error belongs to.
    pub(crate) fn of(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> Self {
        let what = what.into();
        move |reason| Self { what, reason: without_places(&reason.to_string()) }
    }
}

/// The settings of the session. Without access control in the file of `[zenoh]`, no peer may publish what the server
/// publishes of its `vehicles` ([`own_keys`]), beside the downsampling of that file. A message of a peer may be
/// twice as
/// long as `observation_bytes_max`, and [`MESSAGE_BYTES_MAX`] in any case.
///
/// # Errors
/// [`ZenohError`] if the settings are invalid or the file of `[zenoh]` cannot be read.
pub fn settings<'a>(
    options: &Options,
    observation_bytes_max: usize,
    vehicles: impl Iterator<Item = &'a str>,
) -> Result<Config, ZenohError> {
    let mut config = session_config(options, MESSAGE_BYTES_MAX.max(2 * observation_bytes_max))?;
    if config.get_json("access_control/enabled").is_ok_and(|enabled| enabled != "true") {
        let own_keys = own_keys(vehicles);
        let of_file = config.get_json("downsampling").ok().and_then(|json| serde_json::from_str(&json).ok());
        let mut downsampling: Vec<serde_json::Value> = of_file.unwrap_or_default();
        downsampling.push(drop_put(&own_keys));
        for (key, value) in [("access_control", deny_put(&own_keys)), ("downsampling", downsampling.into())] {
            config.insert_json5(key, &value.to_string()).map_err(ZenohError::of(key))?;
        }
    }
    Ok(config)
}

/// Opens the session.
///
/// # Errors
/// [`ZenohError`] if an endpoint is not available, or if it is the client of a router and none answers.
pub(crate) async fn open(config: Config, options: &Options) -> Result<Session, ZenohError> {
    let endpoints = match options.mode {
        ZenohMode::Client => format!("zenoh.connect = {}", options.connect.join(", ")),
        ZenohMode::Peer | ZenohMode::Router => format!("zenoh.listen = {}", options.listen.join(", ")),
    };
    zenoh::open(config).await.map_err(ZenohError::of(format!("open ({endpoints})")))
}

/// The endpoints the session listens on, with the ports that the system chose.
pub(crate) async fn endpoints(session: &Session) -> Vec<String> {
    session.info().locators().await.iter().map(ToString::to_string).collect()
}

/// Declares a publisher whose messages are dropped for a peer that does not receive them.
///
/// # Errors
/// [`ZenohError`] if it cannot be declared.
pub(crate) async fn declare_publisher(
    session: &Session,
    key: String,
    encoding: Encoding,
    priority: Priority,
) -> Result<Publisher<'static>, ZenohError> {
    let publisher = session.declare_publisher(key.clone()).encoding(encoding).priority(priority);
    let publisher = publisher.congestion_control(CongestionControl::Drop).await;
    publisher.map_err(ZenohError::of(format!("publisher {key}")))
}

/// The names in the certificates of the peers at the other end of this session's links.
struct PeerNames {
    session: Session,
    names: BTreeMap<ZenohId, String>,
    read: Option<Instant>,
    /// Reads because of unknown peers: who invents their ids does not keep the server reading.
    reads: TokenBucket,
}

impl PeerNames {
    /// Longest time for which the names are not read again. Ours.
    const AGE_MAX: Duration = Duration::from_secs(1);
    /// Most reads for unknown peers at once, and a second. Ours: as many planners as may start together.
    const READS_AT_ONCE: u32 = 100;
    const READS_PER_SECOND: u32 = 20;

    fn new(session: &Session) -> Self {
        let reads = TokenBucket::new(Self::READS_AT_ONCE, Self::READS_PER_SECOND);
        Self { session: session.clone(), names: BTreeMap::new(), read: None, reads }
    }

    /// The common name in the certificate of a peer; `None` if no link of this session leads to it, or without TLS.
    async fn name(&mut self, peer: ZenohId) -> Option<&str> {
        let is_old = self.read.is_none_or(|read| read.elapsed() > Self::AGE_MAX);
        if is_old || (!self.names.contains_key(&peer) && self.reads.take()) {
            let links = self.session.info().links().await;
            self.names = links.filter_map(|link| Some((*link.zid(), link.auth_identifier()?.to_owned()))).collect();
            self.read = Some(Instant::now());
        }
        self.names.get(&peer).map(String::as_str)
    }
}

/// Who may send observations and queries, if clients have roles.
pub struct Senders {
    peers: PeerNames,
    may_call: MayCall,
}

/// Whether a client with these names in its certificate may do what this RPC does, to this vehicle if one is named; if
/// not, why.
type MayCall = Box<dyn Fn(&str, Option<&str>, &[String]) -> Result<(), String> + Send + Sync>;

impl Senders {
    /// The senders of a session whose peers connect to this server: each shows its own certificate.
    pub fn new(session: &Session, may_call: MayCall) -> Self {
        Self { peers: PeerNames::new(session), may_call }
    }

    /// Checks by the certificate of its link that the sender of a sample or query may do what an RPC does, to a vehicle
    /// if one is named.
    ///
    /// # Errors
    /// Why it may not.
    pub async fn check(&mut self, rpc: &str, vehicle: Option<&str>, source: Option<ZenohId>) -> Result<(), String> {
        let Some(source) = source else {
            return Err("the message does not state its source; with roles it must (zenoh's source_info)".into());
        };
        let name = self.peers.name(source).await.map(str::to_owned);
        (self.may_call)(rpc, vehicle, name.as_slice())
    }
}

fn session_config(options: &Options, message_bytes_max: usize) -> Result<Config, ZenohError> {
    let mut config = match options.file.as_os_str().is_empty() {
        true => limited()?,
        false => {
            let read = Config::from_file(&options.file);
            let mut config = read.map_err(ZenohError::of(format!("zenoh.file {}", options.file.display())))?;
            find_certificates(&mut config, &options.file)?;
            config
        }
    };
    let json = |value: serde_json::Value| value.to_string();
    let settings = [
        ("mode", json(options.mode.as_str().into())),
        ("listen/endpoints", json(options.listened().into())),
        ("connect/endpoints", json(options.connect.clone().into())),
        ("scouting/multicast/enabled", json(options.scouting.into())),
        // Peers behind one router, such as ROS 2 nodes behind rmw_zenohd, reach one another without it.
        ("scouting/gossip/enabled", json((options.scouting || !options.connect.is_empty()).into())),
        ("timestamping/enabled", json(true.into())),
        ("transport/link/rx/max_message_size", json(message_bytes_max.into())),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).map_err(ZenohError::of(format!("{key} = {value}")))?;
    }
    Ok(config)
}

/// Replaces the names of certificates by the paths of the files: beside the configuration of zenoh that names them,
/// else in the folder in which the server was started.
fn find_certificates(config: &mut Config, file: &Path) -> Result<(), ZenohError> {
    for name in CERTIFICATE_FILES {
        let key = format!("transport/link/tls/{name}");
        let value = config.get_json(&key).ok().and_then(|json| serde_json::from_str::<Option<PathBuf>>(&json).ok());
        let Some(path) = value.flatten() else { continue };
        let places = [file.parent().unwrap_or(Path::new("")).join(&path), path.clone()];
        let what = || format!("zenoh.file {}: {key} = {}", file.display(), path.display());
        let Some(found) = places.into_iter().find(|place| place.is_file()) else {
            let reason = "no such file, neither beside that file nor in the folder in which the server was started";
            return Err(ZenohError { what: what(), reason: reason.into() });
        };
        let found = serde_json::Value::from(found.display().to_string());
        config.insert_json5(&key, &found.to_string()).map_err(ZenohError::of(what()))?;
    }
    Ok(())
}

/// A text of zenoh without the files and lines of its source.
fn without_places(text: &str) -> String {
    let mut parts = text.split(" at /");
    let mut kept = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let (place, rest) = part.split_once(' ').unwrap_or((part, ""));
        kept += &match (place.contains(".rs:"), rest) {
            (true, "") => String::new(),
            (true, rest) => format!(" {rest}"),
            (false, _) => format!(" at /{part}"),
        };
    }
    kept
}

/// The keys on which the server publishes.
fn own_keys<'a>(vehicles: impl Iterator<Item = &'a str>) -> Vec<String> {
    let keys = |vehicle| {
        ["", "/status", "/ingest/report", "/replay", "/map/**", "/map/*/@adv/**", "/recorder/*"]
            .map(|rest| format!("clearway/{vehicle}{rest}"))
    };
    vehicles.flat_map(keys).collect()
}

/// Access control under which peers may do everything but publish on these keys. It lets a publication on a key with
/// wildcards through, which [`drop_put`] drops.
fn deny_put(keys: &[String]) -> serde_json::Value {
    serde_json::json!({
        "enabled": true,
        "default_permission": "allow",
        "rules": [{
            "id": "publish as the server", "permission": "deny", "flows": ["ingress"], "key_exprs": keys,
            "messages": ["put", "delete", "reply", "declare_queryable", "liveliness_token"],
        }],
        "subjects": [{ "id": "every peer" }],
        "policies": [{ "rules": ["publish as the server"], "subjects": ["every peer"] }],
    })
}

/// Downsampling to nothing of what peers publish on keys that match one of these, such as `clearway/**`: before it is
/// routed, so that a flood of it costs no reader anything.
fn drop_put(keys: &[String]) -> serde_json::Value {
    let rules: Vec<_> = keys.iter().map(|key| serde_json::json!({ "key_expr": key, "freq": 0.0 })).collect();
    serde_json::json!({
        "id": "publish as the server", "messages": ["put", "delete"], "flows": ["ingress"], "rules": rules,
    })
}

/// zenoh's default settings with [`LIMITS`].
fn limited() -> Result<Config, ZenohError> {
    let mut config = Config::default();
    for (key, value) in LIMITS {
        config.insert_json5(key, value).map_err(ZenohError::of(format!("{key} = {value}")))?;
    }
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_in_deploy_have_the_limits_of_a_server_without_a_file() {
        let limited = limited().unwrap();
        for name in ["server.json5", "router.json5"] {
            let file = format!("{}/../../deploy/zenoh/{name}", env!("CARGO_MANIFEST_DIR"));
            let config = Config::from_file(&file).unwrap();
            for (key, _) in LIMITS {
                assert_eq!(config.get_json(key).unwrap(), limited.get_json(key).unwrap(), "{name}: {key}");
            }
        }
    }

    #[test]
    fn the_downsampling_of_a_zenoh_file_stays_beside_that_of_the_server() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("thin.json5");
        let rule = r#"{ id: "thin", messages: ["put"], flows: ["egress"], rules: [{ key_expr: "a/b", freq: 4.0 }] }"#;
        std::fs::write(&file, format!("{{ downsampling: [{rule}] }}")).unwrap();
        let config = settings(&Options { file, ..Options::default() }, 0, ["car"].into_iter()).unwrap();
        let rules: serde_json::Value = serde_json::from_str(&config.get_json("downsampling").unwrap()).unwrap();
        let ids: Vec<_> = rules.as_array().unwrap().iter().map(|rule| rule["id"].as_str().unwrap()).collect();
        assert_eq!(ids, ["thin", "publish as the server"], "{rules}");
        assert_eq!(rules[0]["rules"][0]["freq"], 4.0, "{rules}");
    }

    #[test]
    fn roles_with_and_without_a_router_are_the_same() {
        let roles = ["server.json5", "router.json5"].map(|name| {
            let file = format!("{}/../../deploy/zenoh/{name}", env!("CARGO_MANIFEST_DIR"));
            Config::from_file(&file).unwrap().get_json("access_control").unwrap()
        });
        assert_eq!(roles[0], roles[1]);
        assert!(roles[0].contains("\"default_permission\":\"deny\""), "{}", roles[0]);
    }
}
