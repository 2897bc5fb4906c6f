//! Why a picture is not drawn.

/// Why a picture is not drawn.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The layer does not have the channel.
    #[error("layer {layer} has no channel {channel:?}; it has {present}")]
    NoChannel {
        /// Name of the layer.
        layer: String,
        /// The channel that is not there.
        channel: String,
        /// The layer's channels.
        present: String,
    },
    /// The picture is larger than PNG allows.
    #[error("encode the picture: {0}")]
    Encoding(#[from] png::EncodingError),
}
