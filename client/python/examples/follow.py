"""Follows the newest map: python follow.py [ADDRESS]"""

import sys

import clearway

address = sys.argv[1] if len(sys.argv) > 1 else "localhost:50051"
for m in clearway.watch(address, layers=["freespace"]):
    layer = m["freespace"]
    state = "STALE" if m.stale else "fresh"
    print(f"map {m.sequence}, {m.age_ms():.0f} ms old, {state}, {m.skipped} skipped, {layer.free.mean():.0%} free")
