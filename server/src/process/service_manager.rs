//! What `serve` tells systemd (`sd_notify`): that it is ready, that it lives, that it stops. Without a service manager
//! nothing is sent.

use std::time::Duration;

use sd_notify::NotifyState;

use clearway_daemon::run::Running;

/// Reports that every address is listened on.
pub fn ready() {
    send(&[NotifyState::Ready, NotifyState::Status("serving")]);
}

/// Reports that the server stops.
pub fn stopping() {
    send(&[NotifyState::Stopping, NotifyState::Status("stopping")]);
}

/// Reports again and again that the server lives: twice in each period of the watchdog, while every engine and every
/// thread of a socket runs. Else it reports what has stopped, and the watchdog restarts the server. Never resolves.
pub async fn report_life(running: &Running) {
    let Some(period) = sd_notify::watchdog_enabled().filter(|period| !period.is_zero()) else {
        return std::future::pending().await;
    };
    let mut every = tokio::time::interval((period / 2).max(Duration::from_millis(1)));
    let mut last_fault = None;
    loop {
        every.tick().await;
        let fault = running.fault();
        match &fault {
            None => send(&[NotifyState::Watchdog]),
            Some(fault) => send(&[NotifyState::Status(fault)]),
        }
        if fault != last_fault {
            match &fault {
                Some(fault) => tracing::error!(%fault, "the watchdog of systemd is not fed"),
                None => send(&[NotifyState::Status("serving")]),
            }
            last_fault = fault;
        }
    }
}

fn send(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::warn!(%error, "the service manager does not take the state");
    }
}
