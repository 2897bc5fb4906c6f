"""Shows the maps of a recording or of a server in Rerun: python rerun_maps.py FILE.mcap|ADDRESS [--save FILE.rrd]

Each layer from above in the vehicle's fixed frame, x up and y left, with its legend and the recorded plans; below it
the age of the maps, whether and why they were stale, and what the planner said.
It needs `pip install 'client/python[rerun]'`.
"""

import argparse
import contextlib
import math

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

import clearway
from clearway.v1 import journal_pb2, map_pb2

PLAN_RGB, PLAN_NS = (255, 79, 217), 2_000_000_000  # As on the server's page.


def blueprint(vehicle, layers):
    def from_above(layer):
        above = {"position": (0, 0, 100), "look_target": (0, 0, 0), "eye_up": (1, 0, 0)}
        eye = rrb.EyeControls3D(**above, tracking_entity=f"world/{vehicle}/{layer}")
        shown = [f"world/{vehicle}", f"world/{vehicle}/{layer}", "world/plan/**"]
        view = rrb.Spatial3DView(origin="world", contents=shown, eye_controls=eye, line_grid=False, name=layer)
        return rrb.Horizontal(view, rrb.Spatial2DView(origin=f"legend/{layer}"), column_shares=[5, 1], name=layer)

    tabs = rrb.Tabs(*map(from_above, layers), active_tab=layers.index("freespace") if "freespace" in layers else 0)
    below = [rrb.TimeSeriesView(origin="age_ms"), rrb.StateTimelineView(origin="state"), rrb.TextLogView(origin="log")]
    root = rrb.Vertical(tabs, rrb.Horizontal(*below), row_shares=[3, 1])
    return rrb.Blueprint(root, rrb.TimePanel(timeline="capture"))


def log(stamp_ns, path, *archetypes):
    rr.set_time("capture", timestamp=np.datetime64(stamp_ns, "ns"))
    rr.log(path, *archetypes)


def log_layer(stamp_ns, path, layer, is_first):
    """A layer in the colours of its legend: squares as an image (its first row is the upper one), rings as a mesh."""
    rgb = b"".join(entry.rgb.to_bytes(3, "big") for entry in layer.legend_entries)
    grid, corners, colours = layer.grid, layer.grid.corners(), np.frombuffer(rgb, np.uint8).reshape(-1, 3)
    if is_first:
        rows = {"mins": [(0, i) for i in range(len(colours))], "sizes": [(2, 0.7)] * len(colours), "labels": layer.legend}
        rr.log(f"legend/{layer.name}", rr.Boxes2D(**rows, colors=colours), static=True)
    cells = colours[layer.classes]
    if isinstance(grid, clearway.CartesianGrid):
        form = rr.components.ImageFormat(grid.width, grid.height, color_model="RGB", channel_datatype="U8")
        turn = rr.RotationAxisAngle((0, 0, 1), radians=-grid.yaw_rad)
        place = {"cell_size": grid.cell_m, "translation": (*corners[0, 0], 0), "rotation_axis_angle": turn}
        log(stamp_ns, path, rr.GridMap(data=cells[::-1].tobytes(), format=form, **place))
        return
    around = np.stack([corners[:-1, :-1], corners[1:, :-1], corners[1:, 1:], corners[:-1, 1:]], axis=2).reshape(-1, 2)
    first = np.arange(0, len(around), 4)[:, None]
    mesh = {"vertex_positions": np.insert(around, 2, 0, axis=1), "vertex_colors": cells.reshape(-1, 3).repeat(4, axis=0)}
    log(stamp_ns, path, rr.Mesh3D(**mesh, triangle_indices=np.concatenate([first + (0, 1, 2), first + (0, 2, 3)])))


def log_plan(plan, map_from_ego):
    """The path, and the footprint at its end."""
    path, outline = np.column_stack([plan.x, plan.y]), np.reshape(plan.footprint_m, (-1, 2))
    headings = plan.heading_rad or [math.atan2(dy, dx) for dx, dy in np.diff(path, axis=0) if dx or dy] or [0.0]
    strips = [np.insert(points, 2, 0.1, axis=1) for points in (path, np.concatenate([outline, outline[:1]]))]
    line, footprint = (rr.LineStrips3D([strip], colors=PLAN_RGB, radii=0.1) for strip in strips)
    frame = plan.map_from_ego if plan.HasField("map_from_ego") else map_from_ego
    frame = map_pb2.Pose(qw=1) if plan.frame == journal_pb2.PLAN_FRAME_MAP else frame
    log(plan.stamp_ns, "world/plan", placed(frame), line)
    end = rr.Transform3D(translation=(*path[-1], 0), rotation=rr.RotationAxisAngle((0, 0, 1), radians=headings[-1]))
    log(plan.stamp_ns, "world/plan/footprint", end, footprint)
    log(plan.stamp_ns, "log", rr.TextLog(f"plan of {plan.planner}: {plan.text}"))


def placed(pose):
    return rr.Transform3D(translation=(pose.x, pose.y, pose.z), quaternion=(pose.qx, pose.qy, pose.qz, pose.qw))


def show(messages, is_live):
    map_from_ego, sequence, valid_until_ns, plan_until_ns = map_pb2.Pose(qw=1), None, math.inf, math.inf
    for m in messages:
        if isinstance(m, journal_pb2.Plan):
            log_plan(m, map_from_ego)
            plan_until_ns = m.stamp_ns + PLAN_NS
            continue
        stamp_ns = m.header.capture_end_ns
        if m.sequence == sequence or valid_until_ns < stamp_ns:
            why = (is_live and m.stale_because) or "no newer map has arrived"
            log(valid_until_ns, "state", rr.StateChange(state=why))
        if m.sequence == sequence:
            continue
        if sequence is None:
            rr.send_blueprint(blueprint(m.vehicle, list(m.layers)))
        if plan_until_ns < stamp_ns:
            log(plan_until_ns, "world/plan", rr.Clear(recursive=True))
            plan_until_ns = math.inf
        map_from_ego = m.header.map_from_ego if m.pose else map_from_ego
        log(stamp_ns, f"world/{m.vehicle}", placed(map_from_ego), rr.TransformAxes3D(2.0))
        log(stamp_ns, "state", rr.StateChange(state=(is_live and m.stale_because) or "fresh"))
        # When it arrived; in a recording, when it was made.
        log(stamp_ns, "age_ms", rr.Scalars(m.age_ms() if is_live else (m.header.completed_ns - stamp_ns) / 1e6))
        for layer in m.layers.values():
            log_layer(stamp_ns, f"world/{m.vehicle}/{layer.name}", layer, is_first=sequence is None)
        sequence, valid_until_ns = m.sequence, m.header.valid_until_ns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", metavar="FILE.mcap|ADDRESS")
    parser.add_argument("--vehicle", default="")
    parser.add_argument("--layers", nargs="+", default=(), help="of a server: all without this; zenoh needs it")
    parser.add_argument("--save", metavar="FILE.rrd", help="writes a file instead of opening a viewer")
    given = parser.parse_args()
    rr.init("clearway")
    rr.save(given.save) if given.save else rr.spawn()
    with contextlib.suppress(KeyboardInterrupt, clearway.ReplayEnded):
        if given.source.endswith(".mcap"):
            show(clearway.read_all(given.source, given.vehicle), is_live=False)
        else:
            show(iter(clearway.watch(given.source, given.vehicle, given.layers).next_or_stale, None), is_live=True)
