//! The layout of the backplane, in words.

use tandem_board::{CoreAddress, CoreId, Edge, Line, SystemId};
use tandem_peripherals::codec::{BusFrame, DATAGRAM_WORDS, FRAME_WORDS, SERVICE_WORDS};
use tandem_peripherals::network::LINK_DATAGRAMS;
use tandem_peripherals::stamp::CAPTURE_WORDS;
use tandem_shm::{Shape, broadcast, fifo};

use crate::trace_ring;

/// A frame on its way to the bus: the frame, the number of discards before it, its mark.
pub(crate) const TRANSMIT_WORDS: usize = FRAME_WORDS + 2;

/// A frame of the transmit ring.
#[derive(Clone, Copy)]
pub(crate) struct Transmit {
    pub(crate) frame: BusFrame,
    /// How often the sender had discarded its waiting frames before.
    pub(crate) discards: u32,
    /// The number of the frame among those that the sender wants stamped; 0 if it is none of them.
    pub(crate) mark: u32,
}

impl Transmit {
    pub(crate) fn encode(&self) -> [u32; TRANSMIT_WORDS] {
        let mut words = [self.discards; TRANSMIT_WORDS];
        words[..FRAME_WORDS].copy_from_slice(&self.frame.encode());
        words[FRAME_WORDS + 1] = self.mark;
        words
    }

    pub(crate) fn decode(words: &[u32; TRANSMIT_WORDS]) -> Option<Self> {
        Some(Self {
            frame: BusFrame::decode(words.first_chunk()?)?,
            discards: words[FRAME_WORDS],
            mark: words[FRAME_WORDS + 1],
        })
    }
}

/// Words of a cache line. Words with different writers are on different lines.
const LINE: usize = 16;
/// Number of writers of traces: the cores and the supplies.
const TRACE_WRITERS: usize = CoreAddress::COUNT + 2;

/// Registers of the run.
#[derive(Clone, Copy)]
pub(super) enum Run {
    Magic,
    LauncherPid,
    VehiclePid,
    Assembled,
    Ignition,
    Stop,
    Cuts,
    /// The id of a forged frame, plus 1; 0 for none.
    ForgedId,
    ForgedField,
    /// Both halves of the value's bits.
    ForgedHigh,
    ForgedLow,
}

/// Registers of a system, grouped by writer: supply (and launcher), then core 0.
#[derive(Clone, Copy)]
pub(super) enum System {
    SupplyPid,
    PowerOns,
    LevelLow,
    ResetCause,
    Starts,
    Booted,
    StaggerUs,
    PowerRequest,
    Faults,
    /// What was done to the system from outside, one bit for each `Deed`.
    Deeds,
    ResetRequest = LINE as isize,
    Lamp,
    Released,
    HeldLow,
    LostOut,
    LostIn,
    /// The id of a frame that core 0 does not hear, plus 1; 0 for none.
    DeafTo0,
    /// The same for core 1.
    DeafTo1,
    LateMs,
}

/// What is done to a system from outside and leaves no trace in other registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Deed {
    PowerOff,
    PowerOn,
    Reset,
    Hang,
    Scribble,
    StrayEdge,
}

impl Deed {
    pub(super) const ALL: [Self; 6] = [
        Self::PowerOff,
        Self::PowerOn,
        Self::Reset,
        Self::Hang,
        Self::Scribble,
        Self::StrayEdge,
    ];
}

/// Registers of a core, grouped by writer: supply, then the core, then the vehicle.
#[derive(Clone, Copy)]
pub(super) enum Core {
    Pid,
    Generation,
    WakeOnReceive = LINE as isize,
    TraceLost,
    Discards,
    Marks,
    CanErrors = 2 * LINE as isize,
    /// The first word of a stamp, which also the core writes.
    CanStamp,
}

const RUN_AT: usize = 0;
const SYSTEMS_AT: usize = RUN_AT + LINE;
const SYSTEM_WORDS: usize = 2 * LINE;
const CORES_AT: usize = SYSTEMS_AT + 2 * SYSTEM_WORDS;
const CORE_WORDS: usize = 3 * LINE;
/// Counts of rising and falling edges on the lines: the sender's, then the receiver's baseline.
const EDGES_AT: usize = CORES_AT + CoreAddress::COUNT * CORE_WORDS;
const EDGE_WORDS: usize = LINE;
/// Stamps of the edges that each system has sent on the time line.
const CAPTURES_AT: usize = EDGES_AT + 4 * EDGE_WORDS;
const RINGS_AT: usize = CAPTURES_AT + (2 * CAPTURE_WORDS).next_multiple_of(LINE);

pub(super) const fn run(register: Run) -> usize {
    RUN_AT + register as usize
}

pub(super) const fn system(system: SystemId, register: System) -> usize {
    SYSTEMS_AT + system.index() * SYSTEM_WORDS + register as usize
}

pub(super) const fn core(system: SystemId, core: CoreId, register: Core) -> usize {
    CORES_AT + CoreAddress::new(system, core).index() * CORE_WORDS + register as usize
}

pub(super) const fn edge(from: SystemId, line: Line, edge: Edge) -> usize {
    EDGES_AT + from.index() * EDGE_WORDS + 2 * line.index() + edge as usize
}

pub(super) const fn edge_baseline(by: SystemId, line: Line, edge_type: Edge) -> usize {
    2 * EDGE_WORDS + edge(by, line, edge_type)
}

/// Returns the first of the words that stamp what `from` sends on the time line.
pub(super) const fn capture(from: SystemId) -> usize {
    CAPTURES_AT + from.index() * CAPTURE_WORDS
}

/// Returns the index of a supply's trace.
pub(crate) const fn supply_trace_ring(system: SystemId) -> usize {
    CoreAddress::COUNT + system.index()
}

/// A ring in the backplane.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ring {
    /// Index of the first word.
    pub(crate) at: usize,
    /// Number of words.
    pub(crate) words: usize,
    /// Number and size of the slots.
    pub(crate) shape: Shape,
}

/// The positions of the rings.
#[derive(Debug)]
pub(crate) struct Rings {
    /// The rings from each core to the bus.
    pub(crate) transmit: [Ring; CoreAddress::COUNT],
    /// The ring from the bus to all cores.
    pub(crate) receive: Ring,
    /// The link from each system to the other.
    pub(crate) link: [Ring; 2],
    /// Watchdog services of each system.
    pub(crate) service: [Ring; 2],
    /// Trace of each core, then of each supply.
    pub(crate) trace: [Ring; TRACE_WRITERS],
}

/// Frames that wait for the bus. Each frame wakes the bus; a disturbed bus reads them every ms.
const TRANSMIT: Shape = Shape::new(64, TRANSMIT_WORDS);
/// Frames by which a core may lag behind: a few hundred milliseconds at the vehicle bus's load.
const RECEIVE: Shape = Shape::new(1024, FRAME_WORDS);
/// Datagrams in transit.
const LINK: Shape = Shape::new(LINK_DATAGRAMS, DATAGRAM_WORDS);
/// Watchdog services by which the supply may fall behind.
const SERVICE: Shape = Shape::new(16, SERVICE_WORDS);

/// The positions of the rings.
pub(crate) const RINGS: Rings = RINGS_AND_END.0;
/// Number of words of the backplane.
pub(super) const WORDS: usize = RINGS_AND_END.1;

const RINGS_AND_END: (Rings, usize) = {
    const fn end(place: Ring) -> usize {
        (place.at + place.words).next_multiple_of(LINE)
    }
    const fn fifo_at(at: usize, shape: Shape) -> Ring {
        Ring {
            at,
            words: fifo::words(shape),
            shape,
        }
    }
    const fn broadcast_at(at: usize, shape: Shape) -> Ring {
        Ring {
            at,
            words: broadcast::words(shape),
            shape,
        }
    }
    let receive = broadcast_at(RINGS_AT, RECEIVE);
    let mut at = end(receive);
    let nothing = Ring {
        at,
        words: 0,
        shape: LINK,
    };
    let mut transmit = [nothing; CoreAddress::COUNT];
    let mut n = 0;
    while n < CoreAddress::COUNT {
        transmit[n] = fifo_at(at, TRANSMIT);
        at = end(transmit[n]);
        n += 1;
    }
    let mut trace = [nothing; TRACE_WRITERS];
    let mut n = 0;
    while n < TRACE_WRITERS {
        // The trace ring defines its own slots; this shape is not used.
        trace[n] = Ring {
            at,
            words: trace_ring::WORDS,
            shape: LINK,
        };
        at = end(trace[n]);
        n += 1;
    }
    let mut link = [nothing; 2];
    let mut service = [nothing; 2];
    let mut n = 0;
    while n < 2 {
        link[n] = fifo_at(at, LINK);
        service[n] = fifo_at(end(link[n]), SERVICE);
        at = end(service[n]);
        n += 1;
    }
    (
        Rings {
            transmit,
            receive,
            link,
            service,
            trace,
        },
        at,
    )
};

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_peripherals::stamp::STAMP_WORDS;

    #[test]
    fn nothing_overlaps() {
        let mut places: Vec<(usize, usize)> = vec![(RINGS.receive.at, RINGS.receive.words)];
        for group in [
            &RINGS.transmit[..],
            &RINGS.trace,
            &RINGS.link,
            &RINGS.service,
        ] {
            places.extend(group.iter().map(|place| (place.at, place.words)));
        }
        for s in SystemId::ALL {
            places.push((capture(s), CAPTURE_WORDS));
            for register in [System::SupplyPid, System::ResetCause, System::Lamp] {
                places.push((system(s, register), 1));
            }
            for c in CoreId::ALL {
                for register in [
                    Core::Pid,
                    Core::Generation,
                    Core::TraceLost,
                    Core::Marks,
                    Core::CanErrors,
                ] {
                    places.push((core(s, c, register), 1));
                }
                places.push((core(s, c, Core::CanStamp), STAMP_WORDS));
            }
            for line in Line::ALL {
                for e in [Edge::Rising, Edge::Falling] {
                    places.push((edge(s, line, e), 1));
                    places.push((edge_baseline(s, line, e), 1));
                }
            }
        }
        places.push((run(Run::Magic), 1));
        places.push((run(Run::ForgedLow), 1));
        places.push((run(Run::Cuts), 1));
        places.sort_unstable();
        for pair in places.windows(2) {
            assert!(pair[0].0 + pair[0].1 <= pair[1].0, "{pair:?}");
        }
        let (at, words) = places[places.len() - 1];
        assert!(at + words <= WORDS);
    }
}
