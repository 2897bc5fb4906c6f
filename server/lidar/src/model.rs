//! The Velodyne models and their nominal figures. Source: the manuals named at each figure.

use serde::{Deserialize, Serialize};

/// A Velodyne sensor model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Model {
    /// HDL-64E S1.
    Hdl64eS1,
    /// HDL-64E S2 (and S2.1).
    Hdl64eS2,
    /// HDL-64E S3.
    Hdl64eS3,
    /// HDL-32E.
    Hdl32e,
    /// VLP-16 (Puck, Puck LITE).
    Vlp16,
    /// Puck Hi-Res.
    PuckHiRes,
    /// VLP-32C (Ultra Puck).
    Vlp32c,
    /// VLS-128 (Alpha Prime).
    Vls128,
}

/// Which echoes the sensor reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReturnMode {
    /// The strongest echo.
    Strongest,
    /// The last echo.
    Last,
    /// Both, in pairs of blocks.
    Dual,
}
