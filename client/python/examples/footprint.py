"""Is there room for the vehicle ahead? python footprint.py [ADDRESS]"""

import sys

import clearway

LENGTH_M, WIDTH_M = 4.5, 2.0
address = sys.argv[1] if len(sys.argv) > 1 else "localhost:50051"
for m in clearway.watch(address, layers=["freespace"]):
    layer = m["freespace"]
    for ahead_m in range(8, 40, 2):
        corners = [(ahead_m + x, y) for x, y in [(0, -1), (LENGTH_M, -1), (LENGTH_M, 1), (0, 1)]]
        if m.stale or not layer.is_free([(x, y * WIDTH_M / 2) for x, y in corners]):
            break
    obstacle = layer.nearest_obstacle()
    print(f"map {m.sequence}: room up to {ahead_m} m ahead; nearest obstacle: {obstacle}")
