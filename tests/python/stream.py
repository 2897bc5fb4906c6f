"""The Python client's stream of maps: answers to one request a line, each as one line of JSON, as
`client/cpp/tests/answers.cpp` answers them.

  watch <address> <once, or reconnects> <deltas: 0 or 1> <layer> ...
  next
  reasons
  arc <layer> <front> <rear> <width> <curvature> <length>
  nearest_obstacle <layer> <x> <y>
"""

import json
import sys

import clearway

maps = m = None


def met(found):
    return None if found is None else [found[0], list(found[1])]


def answered(ask, *words):
    global maps, m
    if ask == "watch":
        address, opens, deltas, *layers = words
        maps = clearway.watch(address, layers=layers, deltas=deltas == "1", reconnect=opens == "reconnects")
        return None
    if ask == "next":
        m = next(maps)
        return [m.header.boot_id, m.sequence, m.skipped, m.left_out, m.stale]
    if ask == "reasons":
        return [reason.encode().hex() for reason in maps.reasons]
    layer, *numbers = words
    numbers = list(map(float, numbers))
    if ask == "arc":
        length_m, low, blocked = m[layer].along(clearway.Arc(*numbers[3:]), clearway.Outline(*numbers[:3]))
        return [length_m, met(low), met(blocked)]
    nearest = m[layer].nearest_obstacle(*numbers)
    return nearest and list(nearest)


for line in sys.stdin:
    try:
        answer = answered(*line.split())
    except clearway.ClearwayError as error:
        answer = {"error": error.reason}
    print(json.dumps(answer), flush=True)
