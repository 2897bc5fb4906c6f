//! `clearway.v1.RecordingService`: requests of operators -> the recorder.

use clearway_proto::v1;
use tonic::{Request, Response, Status};
use v1::recording_service_server::RecordingService;

use crate::record::writer::{Command, ControlError, RecorderControl};

/// The service; without a recorder it refuses every request.
pub(super) struct Recordings {
    pub control: Option<RecorderControl>,
}

impl Recordings {
    async fn send(&self, command: Command) -> Result<Response<v1::RecordingResponse>, Status> {
        self.control()?.send(command).await.map(Response::new).map_err(|error| status(&error))
    }

    fn control(&self) -> Result<&RecorderControl, Status> {
        self.control.as_ref().ok_or_else(|| status(&ControlError::NoRecorder))
    }
}

fn status(error: &ControlError) -> Status {
    match error {
        ControlError::NoRecorder | ControlError::Refused(_) => Status::failed_precondition(error.to_string()),
        ControlError::Reason(_) => Status::invalid_argument(error.to_string()),
        ControlError::NoAnswer => Status::unavailable(error.to_string()),
    }
}

type Answer<T> = Result<Response<T>, Status>;

#[tonic::async_trait]
impl RecordingService for Recordings {
    async fn start(&self, _: Request<v1::StartRecordingRequest>) -> Answer<v1::RecordingResponse> {
        self.send(Command::Start).await
    }

    async fn stop(&self, _: Request<v1::StopRecordingRequest>) -> Answer<v1::RecordingResponse> {
        self.send(Command::Stop).await
    }

    async fn split(&self, _: Request<v1::SplitRecordingRequest>) -> Answer<v1::RecordingResponse> {
        self.send(Command::Split).await
    }

    async fn save(&self, request: Request<v1::SaveRecordingRequest>) -> Answer<v1::RecordingResponse> {
        let v1::SaveRecordingRequest { seconds, reason } = request.into_inner();
        self.send(Command::Save { seconds: seconds.into(), reason }).await
    }

    async fn list(&self, _: Request<v1::ListRecordingsRequest>) -> Answer<v1::ListRecordingsResponse> {
        let control = self.control()?.clone();
        let parts = tokio::task::spawn_blocking(move || control.list()).await;
        let parts = parts.map_err(|error| Status::internal(error.to_string()))?;
        Ok(Response::new(v1::ListRecordingsResponse { parts }))
    }

    async fn status(&self, _: Request<v1::RecordingStatusRequest>) -> Answer<v1::RecordingResponse> {
        Ok(Response::new(self.control()?.status()))
    }
}
