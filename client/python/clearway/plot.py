"""A layer -> a drawing by matplotlib, which is imported only here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .errors import ClearwayError

if TYPE_CHECKING:
    from .layer import Layer


def plot(layer: Layer, axes: Any) -> Any:
    """`Layer.plot`."""
    try:
        from matplotlib import pyplot
        from matplotlib.colors import ListedColormap
        from matplotlib.patches import Patch
    except ImportError:
        raise ClearwayError("matplotlib", "matplotlib is not installed: pip install 'clearway[plot]'") from None
    axes = pyplot.gca() if axes is None else axes
    classes = layer.classes
    colours = [f"#{entry.rgb:06x}" for entry in layer.legend_entries]
    corners = layer.grid.corners()
    drawn = {"cmap": ListedColormap(colours), "vmin": -0.5, "vmax": len(colours) - 0.5}
    axes.pcolormesh(corners[..., 1], corners[..., 0], classes, rasterized=True, **drawn)
    axes.set(title=layer.name, xlabel="y, left [m]", ylabel="x, forward [m]", aspect="equal")
    # The y axis points left.
    axes.set_xlim(corners[..., 1].max(), corners[..., 1].min())
    seen = set(classes.ravel().tolist())
    patches = [Patch(color=colours[i], label=name) for i, name in enumerate(layer.legend) if i in seen]
    axes.legend(handles=patches, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return axes
