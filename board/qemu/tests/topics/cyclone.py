"""Reads `vehicle/can` with Cyclone DDS until its input ends, and prints each frame: the number of the
writer (0 for the first one), id, period, length, data."""

import os
import sys
import threading
import time

# The loopback device is used only if it is named. A writer of Tandem keeps three frames: what is
# lost is asked for at once.
os.environ["CYCLONEDDS_URI"] = """
<CycloneDDS><Domain>
  <General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces></General>
  <Internal>
    <NackDelay>0 ms</NackDelay>
    <AutoReschedNackDelay>5 ms</AutoReschedNackDelay>
  </Internal>
</Domain></CycloneDDS>
"""

from dataclasses import dataclass  # noqa: E402

from cyclonedds.core import Policy, Qos  # noqa: E402
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl import IdlStruct  # noqa: E402
from cyclonedds.idl.annotations import final  # noqa: E402
from cyclonedds.idl.types import array, uint8, uint16, uint32  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402


@dataclass
@final
class CanFrame(IdlStruct, typename="tandem::CanFrame"):
    id: uint32
    period_ms: uint16
    length: uint8
    data: array[uint8, 64]


def main(domain):
    participant = DomainParticipant(int(domain))
    topic = Topic(participant, "vehicle/can", CanFrame)
    qos = Qos(
        Policy.Reliability.Reliable(0),
        Policy.Durability.TransientLocal,
        Policy.History.KeepLast(10_000),
    )
    reader = DataReader(participant, topic, qos=qos)
    print("ready", flush=True)
    threading.Thread(target=read, args=[reader], daemon=True).start()
    sys.stdin.read()
    ended.set()
    written.wait()


ended = threading.Event()
written = threading.Event()


def read(reader):
    writers = []
    lines = []
    while True:
        is_last = ended.is_set()
        for sample in reader.take(N=1000):
            info = sample.sample_info
            if info.valid_data:
                if info.publication_handle not in writers:
                    writers.append(info.publication_handle)
                data = bytes(sample.data[: sample.length]).hex()
                number = writers.index(info.publication_handle)
                lines.append(f"{number} {sample.id} {sample.period_ms} {sample.length} {data}")
        if is_last:
            break
        time.sleep(0.005)
    print("\n".join(lines), flush=True)
    written.set()


main(*sys.argv[1:])
