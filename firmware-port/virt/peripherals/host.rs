//! The carrier's connection to the vehicle process on the host, in step with the machine.

use super::ring::Ring;
use super::{SystemRegisters, ethernet, now, system};
use crate::exit::exit;
use crate::hart::time;
use crate::semihosting::{File, HostError};
use crate::{interrupts, log};
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::Relaxed;
use tandem_board::{CoreAddress, CoreId, Instant, Line, RoleLamp, SystemId};
use tandem_cosim::{
    ANSWER_WORDS, ITEM_WORDS, Item, MAGIC, MAX_WORDS, PACKET_PARTS, PERIOD_NS, REPORT_WORDS,
    Report, packet_parts,
};
use tandem_peripherals::codec::{FRAME_WORDS, packet_words};

const PERIOD_TICKS: u64 = PERIOD_NS / interrupts::TICK_NS;
/// The status of the machine if the vehicle process has ended or its answer is not valid.
const ABANDONED: u16 = 3;

type Buffer = [AtomicU32; MAX_WORDS];

#[unsafe(link_section = ".bss.carrier")]
static OUT: Buffer = [const { AtomicU32::new(0) }; MAX_WORDS];
#[unsafe(link_section = ".bss.carrier")]
static IN: Buffer = [const { AtomicU32::new(0) }; MAX_WORDS];
/// Frames that have been on this machine's bus since the last exchange.
// SAFETY: a queue consists of atomics, for which zero is a valid value.
#[unsafe(link_section = ".bss.carrier")]
static FRAMES: Ring<128, FRAME_WORDS> = unsafe { core::mem::zeroed() };

pub(super) struct Host {
    to: File,
    from: File,
    /// Time of the next exchange, in ticks.
    due: u64,
    /// Number of words in `OUT`.
    len: usize,
}

impl Host {
    /// Opens the pipes; ends the machine if they do not exist.
    pub(super) fn open() -> Self {
        let open = || {
            let to = File::open_to_write(c"to-world")?;
            Ok((to, File::open_to_read(c"from-world")?))
        };
        let (to, from) = open().unwrap_or_else(|error: HostError| abandoned("open", error));
        Self {
            to,
            from,
            due: 0,
            len: 0,
        }
    }

    pub(super) const fn due(&self) -> u64 {
        self.due
    }

    /// Records a frame of the bus for the next exchange.
    pub(super) fn on_bus(&mut self, frame: &[u32; FRAME_WORDS]) {
        // No CAN bus carries more than 128 frames in a millisecond; further frames are dropped.
        let _ = FRAMES.put(frame);
    }

    fn put(&mut self, item: Item) {
        let mut words = [0; ITEM_WORDS];
        let len = item.encode(&mut words);
        for (word, value) in OUT[self.len..].iter().zip(&words[..len]) {
            word.store(*value, Relaxed);
        }
        self.len += len;
    }

    fn has_room(&self) -> bool {
        self.has_room_for(1)
    }

    fn has_room_for(&self, items: usize) -> bool {
        self.len + items * ITEM_WORDS <= MAX_WORDS
    }

    /// Reports events of the systems `here` to the host. Calls `act` for each item of the answer.
    pub(super) fn exchange(&mut self, here: [bool; 2], act: &mut dyn FnMut(Item)) {
        self.due = (time() / PERIOD_TICKS + 1) * PERIOD_TICKS;
        self.write(here)
            .unwrap_or_else(|error| abandoned("write", error));
        let answer = self.read().unwrap_or_else(|error| abandoned("read", error));
        let mut words = [0; ITEM_WORDS];
        let mut at = ANSWER_WORDS;
        while at < answer.len() {
            for (word, value) in words.iter_mut().zip(&answer[at..]) {
                *word = value.load(Relaxed);
            }
            let here = ITEM_WORDS.min(answer.len() - at);
            let mut left = &words[..here];
            let Ok(item) = Item::decode(&mut left) else {
                log!("the world's answer is not valid");
                exit(ABANDONED)
            };
            at += here - left.len();
            act(item);
        }
    }

    fn write(&mut self, here: [bool; 2]) -> Result<(), HostError> {
        self.len = REPORT_WORDS;
        while self.has_room()
            && let Some(words) = FRAMES.take()
        {
            self.put(Item::Frame(words));
        }
        for which in SystemId::ALL {
            if here[which.index()] {
                self.put_packets(which);
            }
        }
        for which in SystemId::ALL {
            if here[which.index()] {
                self.put_traces(which);
            }
        }
        for which in SystemId::ALL {
            if !here[which.index()] {
                self.put_signals(which);
            }
        }
        let of_systems = SystemId::ALL.map(system);
        let traces = of_systems.iter().flat_map(|system| &system.cores);
        let report = Report {
            now: now(),
            lamps: of_systems.map(lamp),
            powered: of_systems.map(|system| system.powered.load(Relaxed)),
            lost: traces.map(|core| core.trace_lost.load(Relaxed)).sum(),
        };
        for (word, value) in OUT.iter().zip(report.encode(self.len)) {
            word.store(value, Relaxed);
        }
        self.to.write(&OUT[..self.len])
    }

    /// Adds the datagrams that a system has sent to the Ethernet.
    fn put_packets(&mut self, which: SystemId) {
        while self.has_room_for(PACKET_PARTS)
            && let Some(words) = ethernet::leaving(which)
        {
            let len = packet_words(words[0]);
            packet_parts(which, &words[..len]).for_each(|item| self.put(item));
        }
    }

    fn put_traces(&mut self, which: SystemId) {
        for core in CoreId::ALL {
            let trace = &system(which).cores[core.index()].trace;
            while self.has_room()
                && let Some(words) = trace.take()
            {
                let from = CoreAddress::new(which, core);
                self.put(Item::Trace { from, words });
            }
        }
    }

    /// Adds the edges and datagrams that were sent to a system that is not in this machine.
    fn put_signals(&mut self, to: SystemId) {
        let registers = system(to);
        let time_edge = registers.time_edge();
        for line in Line::ALL {
            for edge in 0..2 {
                let count = registers.edges[line.index()][edge].swap(0, Relaxed);
                if count != 0 {
                    let line = line.index();
                    // A core may have sent one in between: an edge without time is of no use.
                    let at = time_edge.filter(|it| it.count == count);
                    let at = at.map_or(Instant::ORIGIN, |it| it.at);
                    self.put(Item::Edges {
                        to,
                        line,
                        edge,
                        count,
                        at,
                    });
                }
            }
        }
        while self.has_room()
            && let Some(words) = registers.link.take()
        {
            self.put(Item::Datagram { to, words });
        }
    }

    /// Reads an answer, whose first words give its length.
    fn read(&self) -> Result<&'static [AtomicU32], HostError> {
        self.from.read(&IN[..ANSWER_WORDS])?;
        let len = IN[1].load(Relaxed) as usize;
        if IN[0].load(Relaxed) != MAGIC || !(ANSWER_WORDS..=MAX_WORDS).contains(&len) {
            return Err(HostError);
        }
        self.from.read(&IN[ANSWER_WORDS..len])?;
        Ok(&IN[..len])
    }
}

/// Returns the role that a system shows.
fn lamp(system: &SystemRegisters) -> RoleLamp {
    RoleLamp::from_code(system.lamp.load(Relaxed)).unwrap_or(RoleLamp::Starting)
}

fn abandoned(what: &str, error: HostError) -> ! {
    log!("the world is gone: {what}: {error:?}");
    exit(ABANDONED)
}
