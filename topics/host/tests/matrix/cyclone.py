"""A writer or reader of `vehicle/can` on Cyclone DDS: answers each line that it reads with one."""

import os
import sys

# The loopback device is used only if it is named.
#
# A writer of Tandem keeps three frames, for 30 ms. By default, a reader asks for a missing frame
# once, and again after 100 ms at the earliest. Here it asks at once, and again each 5 ms.
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
from cyclonedds.pub import DataWriter  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402

DATA = 64
PERIOD_MS = 10
# A write of a reliable writer blocks at most for this time, ns.
BLOCKS = 1_000_000_000


@dataclass
@final
class CanFrame(IdlStruct, typename="tandem::CanFrame"):
    id: uint32
    period_ms: uint16
    length: uint8
    data: array[uint8, 64]


def frame(number):
    data = bytes((number + index) % 256 for index in range(DATA))
    return CanFrame(number, PERIOD_MS, DATA, data)


def quality(role, reliability, durability, depth):
    reliable = reliability == "reliable"
    local = durability == "transient-local"
    policies = [
        Policy.Reliability.Reliable(BLOCKS) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if local else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
    ]
    if role == "writer" and local:
        # What late readers get; one sample unless this says otherwise.
        history = Policy.History.KeepLast(depth)
        policies.append(Policy.DurabilityService(0, history, -1, -1, -1))
    return Qos(*policies)


def take(reader):
    numbers = []
    for sample in reader.take(N=1000):
        if sample.sample_info.valid_data:
            assert sample == frame(sample.id), sample
            numbers.append(str(sample.id))
    return " ".join(numbers)


def main(role, domain, reliability, durability, depth):
    participant = DomainParticipant(int(domain))
    topic = Topic(participant, "vehicle/can", CanFrame)
    make = DataWriter if role == "writer" else DataReader
    end = make(participant, topic, qos=quality(role, reliability, durability, int(depth)))
    print("ready", flush=True)
    for line in sys.stdin:
        what, *numbers = line.split()
        answer = ""
        if what == "write":
            end.write(frame(int(numbers[0])))
        elif what == "take":
            answer = take(end)
        elif role == "writer":
            answer = end.get_offered_incompatible_qos_status().total_count
        else:
            answer = end.get_requested_incompatible_qos_status().total_count
        print(answer, flush=True)


main(*sys.argv[1:])
