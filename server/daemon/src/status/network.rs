//! What a server knows of its network: listeners that hang, the router it has no session with, certificates that
//! end, and
//! a configuration that was not read again.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use super::health::seconds;
use crate::base::sync::locked;

/// Time without a router after which that is named. Ours: a router that restarts is back sooner.
const AWAY_NAMED_AFTER: Duration = Duration::from_secs(2);
/// Time before the end of a certificate at which that is named. Ours: a week to write a new one.
const END_NAMED_BEFORE: Duration = Duration::from_secs(7 * 24 * 3600);

/// The configured zenoh routers, while none of them is connected; in the modes `peer` and `router` the endpoints of
/// `zenoh.connect` that do not answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Away {
    /// Time since which no router is connected, or an endpoint does not answer.
    pub since: Instant,
    /// Endpoints of the routers, as configured.
    pub endpoints: String,
    /// Why the newest attempt failed; empty if that is not known.
    pub reason: String,
}

/// What is known of the network, for the status of one vehicle.
#[derive(Debug, Default)]
pub struct Network {
    listener_fault: Mutex<String>,
    router: Mutex<Option<Away>>,
    /// What each certificate is, by its key in the configuration, and its end in seconds since the Unix epoch.
    certificates: Mutex<Vec<(&'static str, i64)>>,
    /// Why the configuration was not read again at the newest SIGHUP; `None` if it was, or there was none.
    refused_reload: Mutex<Option<String>>,
}

impl Network {
    /// Notes which listeners hang or have stopped; empty: none.
    pub fn set_listener_fault(&self, fault: &str) {
        fault.clone_into(&mut locked(&self.listener_fault));
    }

    /// Which listeners hang or have stopped.
    pub fn listener_fault(&self) -> Option<String> {
        Some(locked(&self.listener_fault).clone()).filter(|fault| !fault.is_empty())
    }

    /// Notes that no router is connected, or which endpoints do not answer; `None`: neither, or none is configured.
    pub fn set_away(&self, away: Option<Away>) {
        *locked(&self.router) = away;
    }

    /// Time since when [`Away`] holds; zero if it does not.
    pub fn without_router(&self) -> Duration {
        locked(&self.router).as_ref().map_or(Duration::ZERO, |away| away.since.elapsed())
    }

    /// Notes when the certificates end, by their keys in the configuration, in seconds since the Unix epoch.
    pub fn set_certificates(&self, ends: &[(&'static str, i64)]) {
        ends.clone_into(&mut locked(&self.certificates));
    }

    /// When the certificates end, as [`Self::set_certificates`] was told.
    pub fn certificates(&self) -> Vec<(&'static str, i64)> {
        locked(&self.certificates).clone()
    }

    /// Notes why the configuration was not read again; `None`: it was.
    pub fn set_refused_reload(&self, reason: Option<String>) {
        *locked(&self.refused_reload) = reason;
    }

    /// True if the configuration was read again at the newest SIGHUP, or there was none.
    pub fn is_reloaded(&self) -> bool {
        locked(&self.refused_reload).is_none()
    }

    /// What is wrong, in words, at this time of both clocks (nanoseconds since the Unix epoch), though maps are made.
    pub fn problems(&self, now: Instant, now_ns: i64) -> Vec<String> {
        let away = locked(&self.router).clone().and_then(|away| away_text(&away, now));
        let of_certificate = |(name, end_s): &(&'static str, i64)| end_text(name, *end_s, now_ns / 1_000_000_000);
        let ends: Vec<_> = locked(&self.certificates).iter().filter_map(of_certificate).collect();
        let refused_reload = locked(&self.refused_reload).as_deref().map(reload_text);
        away.into_iter().chain(ends).chain(refused_reload).collect()
    }
}

fn reload_text(reason: &str) -> String {
    format!(
        "the configuration was not read again at the newest SIGHUP: {reason}; certificates, tokens, roles and limits \
         are those of before"
    )
}

fn away_text(away: &Away, now: Instant) -> Option<String> {
    let Away { since, endpoints, reason } = away;
    let lasts = now.saturating_duration_since(*since);
    let reason = if reason.is_empty() { String::new() } else { format!(": {reason}") };
    let text = || format!("no zenoh router at {endpoints} for {}: its readers get no maps{reason}", seconds(lasts));
    (lasts >= AWAY_NAMED_AFTER).then(text)
}

/// Says that a certificate ends soon, or that it has ended; `None` while it is valid for long enough.
pub fn end_text(name: &str, end_s: i64, now_s: i64) -> Option<String> {
    let left = Duration::from_secs((end_s - now_s).unsigned_abs());
    let then = "write a new one there, then SIGHUP";
    match end_s > now_s {
        true if left > END_NAMED_BEFORE => None,
        true => Some(format!("the certificate of {name} ends in {}: {then}", long(left))),
        false => Some(format!("the certificate of {name} ended {} ago: clients refuse it; {then}", long(left))),
    }
}

/// A long time in words.
fn long(time: Duration) -> String {
    match time.as_secs() {
        seconds @ 0..120 => format!("{seconds} s"),
        seconds @ 120..7_200 => format!("{} min", seconds / 60),
        seconds @ 7_200..172_800 => format!("{} h", seconds / 3_600),
        seconds => format!("{} days", seconds / 86_400),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_router_that_is_away_is_named_after_two_seconds_with_the_reason_until_it_is_back() {
        let (network, start) = (Network::default(), Instant::now());
        let at = |s| start + Duration::from_secs(s);
        let (endpoints, reason) = ("tls/router:7447".to_owned(), "refused".to_owned());
        network.set_away(Some(Away { since: start, endpoints, reason }));
        assert_eq!(network.problems(at(1), 0), Vec::<String>::new());
        let text = "no zenoh router at tls/router:7447 for 12 s: its readers get no maps: refused";
        assert_eq!(network.problems(at(12), 0), [text]);
        network.set_away(None);
        assert_eq!(network.problems(at(13), 0), Vec::<String>::new());
    }

    #[test]
    fn a_certificate_is_named_a_week_before_its_end_and_after_it() {
        let (network, now, day) = (Network::default(), Instant::now(), 86_400);
        network.set_certificates(&[("grpc.tls.certificate", 100 * day)]);
        let at = |s: i64| network.problems(now, s * 1_000_000_000).join("; ");
        assert_eq!(at(92 * day), "");
        let named = "the certificate of grpc.tls.certificate ends in 6 days: write a new one there, then SIGHUP";
        assert_eq!(at(94 * day), named);
        let ended = "the certificate of grpc.tls.certificate ended 3 h ago: clients refuse it; write a new one there, \
                     then SIGHUP";
        assert_eq!(at(100 * day + 3 * 3600), ended);
    }

    #[test]
    fn a_refused_reload_is_named_until_one_is_accepted() {
        let (network, now) = (Network::default(), Instant::now());
        assert!(network.is_reloaded());
        network.set_refused_reload(Some("unknown field `rolls`".to_owned()));
        let text = "the configuration was not read again at the newest SIGHUP: unknown field `rolls`; certificates, \
                    tokens, roles and limits are those of before";
        assert_eq!((network.problems(now, 0), network.is_reloaded()), (vec![text.to_owned()], false));
        network.set_refused_reload(None);
        assert_eq!((network.problems(now, 0), network.is_reloaded()), (vec![], true));
    }
}
