//! The connections between the two systems: lines, link, CAN bus. The machine has none of them:
//! words in a bank of the SRAM, outside the LMUs, replace the wires.

use super::{Cast, player};
use crate::cpu::CPUS;
use crate::mhu::{self, Unit};
use crate::timers;
use core::cell::{Cell, RefCell};
use core::sync::atomic::{AtomicU32, Ordering};
use tandem_board::{
    Can, CanErrors, CanFrame, CoreAddress, CoreId, Edge, Instant, Line, Lines, Link, LinkFull,
    Received, SystemId, TimeEdge, TransmitFull,
};
use tandem_peripherals::codec::{
    BusFrame, DATAGRAM_MAX_WORDS, DATAGRAM_WORDS, FRAME_WORDS, Reach, Sender, decode_datagram,
    encode_datagram,
};
use tandem_peripherals::network::LINK_DATAGRAMS;
use tandem_peripherals::stamp::{CAPTURE_WORDS, Capture};
use tandem_shm::fifo::{self, Consumer, Producer};
use tandem_shm::{Shape, bare};

/// The queue of datagrams that were sent and not yet received.
const DATAGRAMS: Shape = Shape::new(LINK_DATAGRAMS, DATAGRAM_WORDS);
/// The queue of frames that were sent and not yet received.
const FRAMES: Shape = Shape::new(64, FRAME_WORDS);

/// Words that start at a cache line.
#[repr(C, align(64))]
struct Words<const N: usize>([AtomicU32; N]);

impl<const N: usize> Words<N> {
    const fn new() -> Self {
        Self([const { AtomicU32::new(0) }; N])
    }
}

/// All wires. Zero at power-on.
struct Wires {
    /// Numbers of edges, by receiving system, line and type.
    edges: [[[AtomicU32; 2]; Line::ALL.len()]; 2],
    /// Stamps of the newest rising edges of the time line, by receiving system.
    captured: [[AtomicU32; CAPTURE_WORDS]; 2],
    /// Datagrams, by receiving system.
    link: [Words<{ fifo::words(DATAGRAMS) }>; 2],
    /// Frames, by receiving processor.
    can: [Words<{ fifo::words(FRAMES) }>; CPUS],
    /// Numbers of frames that were lost because the FIFO was full, by receiving processor.
    overruns: [AtomicU32; CPUS],
    /// Not 0: a frame wakes the processor.
    wakes: [AtomicU32; CPUS],
}

#[unsafe(link_section = ".bss.wires")]
static WIRES: Wires = Wires {
    edges: [const { [const { [const { AtomicU32::new(0) }; 2] }; Line::ALL.len()] }; 2],
    captured: [const { [const { AtomicU32::new(0) }; CAPTURE_WORDS] }; 2],
    link: [const { Words::new() }; 2],
    can: [const { Words::new() }; CPUS],
    overruns: [const { AtomicU32::new(0) }; CPUS],
    wakes: [const { AtomicU32::new(0) }; CPUS],
};

/// Returns an end. An error cannot occur, because link.x and the types ensure size and alignment.
fn fits<T, E>(end: Result<T, E>) -> T {
    match end {
        Ok(end) => end,
        Err(_) => unreachable!("the wires are laid out for their ends"),
    }
}

/// The lines of one system.
#[derive(Debug)]
pub struct An521Lines {
    own: SystemId,
    /// The processor that the peer's start line interrupts.
    peer_core_0: Option<usize>,
}

impl An521Lines {
    pub(super) fn new(own: SystemId, cast: &Cast) -> Self {
        Self {
            own,
            peer_core_0: player(cast, own.peer(), CoreId::CONTROL),
        }
    }

    /// The sender stamps an edge for the receiver: both processors have one clock.
    fn capture(to: SystemId) -> Capture<'static> {
        Capture {
            count: &WIRES.edges[to.index()][Line::Time.index()][Edge::Rising as usize],
            stamps: &WIRES.captured[to.index()],
        }
    }
}

impl Lines for An521Lines {
    fn send(&self, line: Line, edge: Edge) {
        if (line, edge) == (Line::Time, Edge::Rising) {
            return Self::capture(self.own.peer()).edge(timers::now);
        }
        let edges = &WIRES.edges[self.own.peer().index()][line.index()];
        // Release pairs with the Acquire in `received`, so that edges arrive in order, as on wires.
        edges[edge as usize].fetch_add(1, Ordering::Release);
        if let (true, Some(cpu)) = (line.interrupts(), self.peer_core_0) {
            mhu::interrupt(Unit::Wires, cpu);
        }
    }

    fn received(&self, line: Line, edge: Edge) -> u32 {
        // Acquire pairs with the Release in `send`.
        WIRES.edges[self.own.index()][line.index()][edge as usize].load(Ordering::Acquire)
    }

    fn time_edge(&self) -> Option<TimeEdge> {
        Self::capture(self.own).newest(0)
    }

    /// Returns true: both systems share the power of the machine.
    fn peer_powered(&self) -> bool {
        true
    }
}

/// The link of one system. Only its core 0 uses it.
#[derive(Debug)]
pub struct An521Link {
    to_peer: RefCell<Producer<'static, [u32; DATAGRAM_WORDS]>>,
    from_peer: RefCell<Consumer<'static, [u32; DATAGRAM_WORDS]>>,
}

impl An521Link {
    pub(super) fn new(own: SystemId) -> Self {
        let [to_peer, from_peer] = [own.peer(), own].map(|to| &WIRES.link[to.index()].0[..]);
        Self {
            to_peer: RefCell::new(fits(bare::fifo_producer(to_peer, DATAGRAMS))),
            from_peer: RefCell::new(fits(bare::fifo_consumer(from_peer, DATAGRAMS))),
        }
    }
}

impl Link for An521Link {
    const MAX_WORDS: usize = DATAGRAM_MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        let sent = self.to_peer.borrow_mut().send(&encode_datagram(words));
        sent.map_err(|fifo::Full| LinkFull)
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        let datagram = self.from_peer.borrow_mut().receive().ok()??;
        Some(decode_datagram(&datagram, words))
    }
}

/// The CAN controller of one core. With two cores, the bus is one queue in each direction.
#[derive(Debug)]
pub struct An521Can {
    of: CoreAddress,
    own: usize,
    other: usize,
    /// Whether there is no other core, so that frames are dropped.
    alone: bool,
    transmit: RefCell<Producer<'static, [u32; FRAME_WORDS]>>,
    receive: RefCell<Consumer<'static, [u32; FRAME_WORDS]>>,
    stamp: Cell<Option<Instant>>,
}

impl An521Can {
    pub(super) fn new(of: CoreAddress, own: usize, cast: &Cast) -> Self {
        let other = 1 - own;
        let [transmit, receive] = [other, own].map(|to| &WIRES.can[to].0[..]);
        Self {
            of,
            own,
            other,
            alone: cast[other].is_none(),
            transmit: RefCell::new(fits(bare::fifo_producer(transmit, FRAMES))),
            receive: RefCell::new(fits(bare::fifo_consumer(receive, FRAMES))),
            stamp: Cell::new(None),
        }
    }

    /// Sends the frame at once, and returns when; if the receiver's queue is full, the frame is
    /// lost. `None` without a receiver: then nothing is sent.
    fn send(&self, frame: &CanFrame) -> Option<Instant> {
        if self.alone {
            return None;
        }
        let at = timers::now();
        let frame = BusFrame {
            received: Received { frame: *frame, at },
            sender: Sender::Core(self.of),
            reach: Reach::ALL,
        };
        if self.transmit.borrow_mut().send(&frame.encode()).is_err() {
            WIRES.overruns[self.other].fetch_add(1, Ordering::Relaxed);
        } else if WIRES.wakes[self.other].load(Ordering::Relaxed) != 0 {
            mhu::interrupt(Unit::Wires, self.other);
        }
        Some(at)
    }
}

impl Can for An521Can {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send(frame);
        Ok(())
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.stamp.set(self.send(frame));
        Ok(())
    }

    fn stamp(&self) -> Option<Instant> {
        self.stamp.get()
    }

    /// Does nothing: `try_send` sends each frame at once.
    fn discard_unsent(&self) {}

    fn try_receive(&self) -> Option<Received> {
        let words = self.receive.borrow_mut().receive().ok()??;
        BusFrame::decode(&words).map(|frame| frame.received)
    }

    fn wake_on_receive(&self, on: bool) {
        WIRES.wakes[self.own].store(on.into(), Ordering::Relaxed);
    }

    fn overruns(&self) -> u32 {
        WIRES.overruns[self.own].load(Ordering::Relaxed)
    }

    /// Returns no errors, because this bus destroys no frames.
    fn errors(&self) -> CanErrors {
        CanErrors::default()
    }
}
