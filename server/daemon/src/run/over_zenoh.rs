//! Everything of a running server that uses the zenoh session: maps out, observations in, live ROS 2 topics in.

use std::net::SocketAddr;

use tokio::task::JoinSet;
use zenoh::Session;
use zenoh::pubsub::Subscriber;

use super::plans_over_zenoh;
use crate::config::{Config, ZenohMode};
use crate::fleet::Fleet;
use crate::ingest::gateway::Gateways;
use crate::ingest::queue::EventQueue;
use crate::ingest::ros::live::{self, LiveTopics};
use crate::ingest::zenoh::ZenohIngest;
use crate::publish::listen::access::Access;
use crate::publish::zenoh::Publisher;
use crate::publish::{Vehicles, announcements, zenoh_recorder};
use crate::record::writer::RecorderControl;
use crate::zenoh_session::{self, Senders, ZenohError};

/// What of a server uses the session.
#[derive(Clone)]
pub(super) struct Users {
    pub config: Config,
    pub vehicles: Vehicles,
    pub gateways: Gateways,
    /// The event queue of each vehicle.
    pub queues: Vec<EventQueue>,
    /// The vehicles of other servers.
    pub fleet: Fleet,
    /// The address at which gRPC listens.
    pub grpc: Option<SocketAddr>,
    /// The recorder, if the server records.
    pub recorder: Option<RecorderControl>,
}

/// The open session and its users.
pub(super) struct OverZenoh {
    session: Session,
    publisher: Publisher,
    /// One task a vehicle.
    ingest: JoinSet<()>,
    ros: Vec<LiveTopics>,
    /// One task a vehicle.
    announcements: JoinSet<()>,
    /// The keys of the announcements.
    announced: Vec<String>,
    /// One task a vehicle.
    recorder: JoinSet<()>,
    _fleet: Option<Subscriber<()>>,
}

impl OverZenoh {
    /// Publishes all vehicles on an open session, subscribes to their observations and ROS 2 topics, and answers the
    /// queries of operators to the recorder. Announces the vehicles with the address at which gRPC listens, and fills
    /// the fleet with the vehicles of others.
    ///
    /// # Errors
    /// [`ZenohError`] if a key cannot be declared.
    pub(super) async fn start(session: Session, users: &Users) -> Result<Self, ZenohError> {
        let Users { config, vehicles, gateways, queues, fleet, grpc, recorder: control } = users;
        let publisher = Publisher::start(&session, &config.zenoh, vehicles).await?;
        let (mut announcements, mut announced) = (JoinSet::new(), Vec::new());
        if config.zenoh.fleet.announce {
            let address = grpc.and_then(|bound| config.grpc.advertised(bound)).unwrap_or_default();
            let of_grpc_and_page = (&*address, &*config.page.advertise);
            announced = announcements::announce(&session, vehicles, of_grpc_and_page, &mut announcements).await?;
        }
        let others = match config.zenoh.fleet.list {
            true => Some(announcements::hear(&session, fleet.clone(), vehicles.clone()).await?),
            false => None,
        };
        let (mut ingest, mut ros, mut recorder) = (JoinSet::new(), Vec::new(), JoinSet::new());
        for gateway in gateways.all() {
            let subscribed = ZenohIngest::subscribe(&session, gateway.clone(), senders(&session, config)).await?;
            ingest.spawn(subscribed.run());
        }
        for served in vehicles.0.iter() {
            plans_over_zenoh::take(&session, served, senders(&session, config), &mut ingest).await?;
        }
        for (vehicle, queue) in config.vehicles.iter().zip(queues) {
            let operators = senders(&session, config);
            zenoh_recorder::serve(&session, &vehicle.name, control.clone(), operators, &mut recorder).await?;
            let Some(topics) = &vehicle.ros else { continue };
            let sensors = vehicle.sensors.iter().map(|sensor| &sensor.name);
            ros.push(live::subscribe(&session, topics, &vehicle.name, sensors, queue.clone()).await?);
        }
        Ok(Self { session, publisher, ingest, ros, announcements, announced, recorder, _fleet: others })
    }

    /// True if the session is connected to a router.
    pub(super) async fn has_router(&self) -> bool {
        self.session.info().routers_zid().await.next().is_some()
    }

    /// The endpoints the session listens on.
    pub(super) async fn endpoints(&self) -> Vec<String> {
        zenoh_session::endpoints(&self.session).await
    }

    /// Ends the ROS 2 subscriptions; no message enters a queue after this.
    pub(super) async fn stop_ros(&mut self) {
        for topics in self.ros.drain(..) {
            topics.stop().await;
        }
    }

    /// Ends publishing and ingest, and closes the session.
    pub(super) async fn stop(mut self) {
        self.announcements.shutdown().await;
        announcements::take_back(&self.session, &self.announced).await;
        self.ingest.shutdown().await;
        self.recorder.shutdown().await;
        self.publisher.stop().await;
        if let Err(error) = self.session.close().await {
            tracing::warn!(%error, "zenoh: close");
        }
    }
}

/// Who may send observations and queries, if clients have roles and connect to this session; a router checks its own
/// clients.
fn senders(session: &Session, config: &Config) -> Option<Senders> {
    let has_roles = config.grpc.tls.as_ref().is_some_and(|tls| tls.client_ca.is_some());
    let access = (has_roles && config.zenoh.mode != ZenohMode::Client).then(|| Access::new(&config.grpc.access))?;
    let may_call = move |rpc: &str, vehicle: Option<&str>, names: &[String]| {
        let caller = access.check(rpc, names);
        let checked = caller.and_then(|caller| vehicle.map_or(Ok(()), |vehicle| caller.check_vehicle(vehicle)));
        checked.map_err(|status| status.message().to_owned())
    };
    Some(Senders::new(session, Box::new(may_call)))
}
