//! The status bytes of an HDL-64E S2 or S3: what the sensor sends about itself, one byte per packet.
//!
//! In: the packets of the sensor. Out: telemetry, and the model and corrections to use from the next revolution on.

use std::sync::Arc;

use crate::calibration::{Calibration, status_table::StatusTable};
use crate::config::SensorConfig;
use crate::datagram::packet::Packet;
use crate::datagram::telemetry::Telemetry;
use crate::model::{Model, ReturnMode};
use crate::time::status_clock::StatusClock;

/// Reader of the status bytes of one sensor.
#[derive(Clone, Debug)]
pub(super) struct StatusBytes {
    table: StatusTable,
    clock: StatusClock,
    /// True if the model may be changed, because none is configured.
    model_is_open: bool,
    /// True if the corrections may be changed, because none are configured.
    calibration_is_open: bool,
    /// Model that was found and is not in use yet.
    pub model: Option<Model>,
    /// Corrections that were found and are not in use yet.
    pub calibration: Option<Arc<Calibration>>,
}

impl StatusBytes {
    pub fn new(config: &SensorConfig) -> Self {
        Self {
            table: StatusTable::default(),
            clock: StatusClock::default(),
            model_is_open: config.model.is_none(),
            calibration_is_open: config.calibration.is_none(),
            model: None,
            calibration: None,
        }
    }

    /// Adds a packet of an HDL-64E, and returns telemetry if its status completes it. `model` and `calibration` are the
    /// present model and table.
    pub fn push(
        &mut self,
        packet: &Packet<'_>,
        model: Model,
        mode: ReturnMode,
        calibration: &Calibration,
    ) -> Option<Telemetry> {
        if !model.is_hdl64e() || model == Model::Hdl64eS1 {
            return None;
        }
        let telemetry = self.clock.push(packet.status(), packet.device_us());
        let found = self.table.push(packet.status());
        let is_s3 = self.table.is_s3() || mode == ReturnMode::Dual;
        if is_s3 && self.model_is_open && model == Model::Hdl64eS2 {
            self.model = Some(Model::Hdl64eS3);
        }
        if let Some((_, found)) = found.filter(|_| self.calibration_is_open)
            && *calibration != found
        {
            self.calibration = Some(Arc::new(found));
        }
        telemetry
    }
}
