"""Reads a Perfetto trace by Perfetto's own description (`pip install perfetto protobuf`), and refuses
one whose slices cross or never end, whose time goes back, or whose arrows lack an end.

    python3 tests/trace/perfetto_oracle.py tandem-report/trace.perfetto-trace

Prints what it found as JSON. Without an argument it reads stdin.
"""

import collections
import json
import sys

from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent


def no_unknown(message, path):
    """Every field is one that the description knows."""
    from google.protobuf.unknown_fields import UnknownFieldSet

    unknown = [field.field_number for field in UnknownFieldSet(message)]
    assert not unknown, f"{path}: unknown fields {unknown}"
    for field, value in message.ListFields():
        if field.message_type is not None:
            values = [value] if hasattr(value, "ListFields") else value
            for one in values:
                no_unknown(one, f"{path}.{field.name}")


def main():
    data = open(sys.argv[1], "rb").read() if len(sys.argv) > 1 else sys.stdin.buffer.read()
    trace = Trace()
    trace.ParseFromString(data)
    names, figures, tracks = {}, {}, {}
    stacks = collections.defaultdict(list)
    last = {}
    begun, ended = {}, {}
    slices = collections.Counter()
    instants = collections.Counter()
    counters = collections.Counter()
    late = 0
    for packet in trace.packet:
        no_unknown(packet, "packet")
        assert packet.trusted_packet_sequence_id == 1
        for name in packet.interned_data.event_names:
            names[name.iid] = name.name
        for name in packet.interned_data.debug_annotation_names:
            figures[name.iid] = name.name
        if packet.HasField("track_descriptor"):
            track = packet.track_descriptor
            assert track.uuid and track.uuid not in tracks
            assert not track.parent_uuid or track.parent_uuid in tracks
            tracks[track.uuid] = track
        if not packet.HasField("track_event"):
            continue
        event, at = packet.track_event, packet.timestamp
        track = tracks[event.track_uuid]
        assert last.get(track.uuid, 0) <= at, f"time goes back on {track}"
        last[track.uuid] = at
        key = track.thread.thread_name or track.name
        if event.type == TrackEvent.TYPE_SLICE_BEGIN:
            stacks[track.uuid].append(names[event.name_iid])
            slices[key] += 1
        elif event.type == TrackEvent.TYPE_SLICE_END:
            assert stacks[track.uuid], f"an end without a begin on {key}"
            stacks[track.uuid].pop()
        elif event.type == TrackEvent.TYPE_INSTANT:
            instants[names[event.name_iid]] += 1
        else:
            assert event.type == TrackEvent.TYPE_COUNTER and track.HasField("counter")
            counters[track.name] += 1
        for figure in event.debug_annotations:
            late += figures[figure.name_iid].startswith("late")
        for flow in event.flow_ids:
            assert flow not in begun
            begun[flow] = at
        for flow in event.terminating_flow_ids:
            assert flow not in ended
            ended[flow] = at
    assert not any(stacks.values()), "slices without an end"
    assert begun.keys() == ended.keys(), "arrows with one end"
    assert all(ended[flow] >= begun[flow] for flow in begun), "arrows that go back"
    processes = [t.process.process_name for t in tracks.values() if t.HasField("process")]
    found = {
        "packets": len(trace.packet),
        "processes": sorted(processes),
        "slices": dict(sorted(slices.items())),
        "slices_of_cores": sum(n for key, n in slices.items() if key.startswith("core ")),
        "instants": dict(sorted(instants.items())),
        "counters": dict(sorted(counters.items())),
        "flows": len(begun),
        "late": late,
    }
    print(json.dumps(found, indent=2, ensure_ascii=False))


main()
