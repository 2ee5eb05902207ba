"""Reads a run as Foxglove does, with libraries that are not ours. Prints JSON.

    oracle.py file FILE     the channels of an MCAP file, and what its messages say
    oracle.py live PORT     the channels of a server, and the first messages of some
"""

import json
import struct
import sys

PROTOBUF = ["/events", "/log", "/tracks", "/trajectory", "/vehicle/pose"]


def of_file(path):
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    channels, events, logs, gaps, obeyed, tracks, points, poses = {}, [], [], [], [], 0, set(), []
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            count = summary.statistics.channel_message_counts.get(channel.id, 0)
            channels[channel.topic] = [channel.message_encoding, schema.name, schema.encoding, count]
            if channel.message_encoding == "json":
                assert json.loads(schema.data)["type"] == "object", channel.topic
        metadata = {it.name: it.metadata for it in reader.iter_metadata()}
        for schema, channel, message in reader.iter_messages():
            topic = channel.topic
            if channel.message_encoding == "json":
                value = json.loads(message.data)
                allowed = json.loads(schema.data)["properties"]
                assert set(value) <= set(allowed), (topic, value)
                if topic == "/gaps":
                    gaps.append(value["gap"])
                if topic == "/roles":
                    obeyed.append(value["obeyed"])
        for _, channel, message, value in reader.iter_decoded_messages(topics=PROTOBUF):
            topic = channel.topic
            if topic == "/events":
                event = {pair.key: pair.value for pair in value.metadata}
                event["took_ms"] = (value.end_time.ToNanoseconds() - value.start_time.ToNanoseconds()) * 1e-6
                events.append(event)
            if topic == "/log":
                logs.append(f"{value.name}: {value.message}")
            if topic == "/tracks":
                tracks = max(tracks, len(value.entities))
            if topic == "/trajectory":
                points.add(len(value.entities[0].lines[0].points))
            if topic == "/vehicle/pose":
                assert value.timestamp.ToNanoseconds() == message.log_time
                poses.append((value.pose.position.x, value.pose.position.y))
    return {
        "channels": channels, "metadata": metadata, "events": events, "logs": logs,
        "gap_max_ms": max(gaps), "obeyed": sorted(set(obeyed)), "tracks": tracks,
        "points": sorted(points), "seconds": (summary.statistics.message_end_time
                                              - summary.statistics.message_start_time) * 1e-9,
        "driven_m": sum(((a - c) ** 2 + (b - d) ** 2) ** 0.5
                        for (a, b), (c, d) in zip(poses, poses[1:])),
    }


def of_server(port):
    from websockets.sync.client import connect

    channels, heard = {}, {}
    wanted = ["/roles", "/vehicle", "/tracks", "/trajectory"]
    with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        while len(heard) < len(wanted):
            try:
                message = socket.recv(timeout=60)
            except Exception as error:
                sys.exit(f"heard only {heard} of {sorted(channels)}: {error}")
            if isinstance(message, str):
                message = json.loads(message)
                if message["op"] == "advertise":
                    new = {it["topic"]: it for it in message["channels"]}
                    channels.update(new)
                    subscriptions = [{"id": 100 + it["id"], "channelId": it["id"]}
                                     for it in new.values() if it["topic"] in wanted]
                    socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
                continue
            kind, subscription, _ = struct.unpack("<BIQ", message[:13])
            if kind != 1:
                continue
            topic = next(it["topic"] for it in channels.values() if it["id"] == subscription - 100)
            is_json = channels[topic]["encoding"] == "json"
            heard[topic] = json.loads(message[13:]) if is_json else len(message) - 13
    return {"channels": {topic: it["schemaName"] for topic, it in channels.items()}, "heard": heard}


command, place = sys.argv[1:]
print(json.dumps({"file": of_file, "live": of_server}[command](place)))
