//! One layer of a map -> JSON: geometry, pose, stamps, sensors, legend, metrics, and the cells if they are wanted.

use clearway_client::codec::Cells;
use clearway_client::grid::Grid;
use clearway_client::{Channel, Layer, MapView};
use serde_json::{Value, json};

use clearway_daemon::status::sensor_json;

/// The layer and the header of its map as one JSON object. Arrays of cells are row by row, in the order of the grid's
/// cell index.
pub fn layer(map: &MapView, layer: &Layer, with_cells: bool) -> Value {
    let header = map.header();
    let geometry = match &layer.grid {
        Grid::Radial { centre_m, row_radius_m, columns } => {
            json!({"kind": "radial", "centre_m": centre_m, "row_radius_m": row_radius_m, "columns": columns})
        }
        Grid::Cartesian { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_ix, first_iy } => json!({
            "kind": "cartesian", "origin_x_m": origin_x_m, "origin_y_m": origin_y_m, "width": width,
            "height": height, "cell_m": cell_m, "yaw_rad": yaw_rad, "first_ix": first_ix, "first_iy": first_iy,
        }),
    };
    let pose = header
        .map_from_ego
        .as_ref()
        .map(|p| json!({"x": p.x, "y": p.y, "z": p.z, "qx": p.qx, "qy": p.qy, "qz": p.qz, "qw": p.qw}));
    let (rows, columns) = layer.grid.shape();
    json!({
        "vehicle": header.vehicle,
        "boot_id": header.boot_id,
        "sequence": header.sequence,
        "capture_start_ns": header.capture_start_ns,
        "capture_end_ns": header.capture_end_ns,
        "completed_ns": header.completed_ns,
        "valid_until_ns": header.valid_until_ns,
        "map_from_ego": pose,
        "speed_mps": header.speed_mps,
        "compensation": header.compensation,
        "sensors": header.sensors.iter().map(sensor_json).collect::<Vec<_>>(),
        "layer": layer.name,
        "geometry": geometry,
        "shape": [rows, columns],
        "legend": layer.legend.iter().map(|class| &class.name).collect::<Vec<_>>(),
        "legend_meanings": layer.legend.iter().map(|class| class.meaning.as_str_name()).collect::<Vec<_>>(),
        "legend_rgb": layer.legend.iter().map(|class| format!("#{:06x}", class.rgb)).collect::<Vec<_>>(),
        "planes": layer.planes,
        "metrics": layer.metrics,
        "channels": layer.channels.iter().map(|c| channel(c, with_cells)).collect::<Vec<_>>(),
    })
}

fn channel(channel: &Channel, with_cells: bool) -> Value {
    let dtype = match channel.cells {
        Cells::U8(_) => "u1",
        Cells::I8(_) => "i1",
        Cells::U16(_) => "u2",
    };
    let mut document = json!({
        "name": channel.name, "unit": channel.unit, "scale": channel.scale, "unknown": channel.unknown, "dtype": dtype,
    });
    if with_cells {
        document["cells"] = match &channel.cells {
            Cells::U8(cells) => json!(cells),
            Cells::I8(cells) => json!(cells),
            Cells::U16(cells) => json!(cells),
        };
    }
    document
}
