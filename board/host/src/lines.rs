//! The wires to the other system: lines and data link.

use std::sync::{Arc, Mutex, PoisonError};

use tandem_board::{CoreId, Edge, Identity, Line, Lines, Link, LinkFull, TimeEdge};
use tandem_peripherals::codec::{
    DATAGRAM_MAX_WORDS, DATAGRAM_WORDS, decode_datagram, encode_datagram,
};
use tandem_peripherals::network::Wire;
use tandem_shm::{FitError, bare, fifo};

use crate::backplane::{Backplane, RINGS};
use crate::doorbell::Ringers;

/// A system's end of the lines.
#[derive(Debug)]
pub struct HostLines {
    backplane: Backplane,
    of: Identity,
    ringers: Arc<Ringers>,
}

impl HostLines {
    pub(crate) fn new(backplane: Backplane, of: Identity, ringers: Arc<Ringers>) -> Self {
        Self {
            backplane,
            of,
            ringers,
        }
    }
}

impl Lines for HostLines {
    fn send(&self, line: Line, edge: Edge) {
        let arrives = self.backplane.send_edge(self.of.system, line, edge);
        if line.interrupts() && arrives {
            self.ringers.ring(self.of.system.peer(), CoreId::CONTROL);
        }
    }

    fn received(&self, line: Line, edge: Edge) -> u32 {
        self.backplane.received_edges(self.of.system, line, edge)
    }

    fn time_edge(&self) -> Option<TimeEdge> {
        self.backplane.time_edge(self.of.system)
    }

    fn peer_powered(&self) -> bool {
        self.backplane.level_at_peer(self.of.system.peer())
    }
}

/// A system's end of the data link. It is connected to core 0: the other cores can neither send nor
/// receive on it.
#[derive(Debug)]
pub struct HostLink {
    backplane: Backplane,
    of: Identity,
    ends: Option<Ends>,
}

#[derive(Debug)]
struct Ends {
    send: Mutex<fifo::Producer<'static, [u32; DATAGRAM_WORDS]>>,
    receive: Mutex<fifo::Consumer<'static, [u32; DATAGRAM_WORDS]>>,
}

impl HostLink {
    pub(crate) fn attach(backplane: Backplane, of: Identity) -> Result<Self, FitError> {
        let ends = if of.core == CoreId::CONTROL {
            let (out, back) = (of.system.index(), of.system.peer().index());
            let (out, back) = (RINGS.link[out], RINGS.link[back]);
            Some(Ends {
                send: Mutex::new(bare::fifo_producer(backplane.ring(out), out.shape)?),
                receive: Mutex::new(bare::fifo_consumer(backplane.ring(back), back.shape)?),
            })
        } else {
            None
        };
        Ok(Self {
            backplane,
            of,
            ends,
        })
    }
}

impl Link for HostLink {
    const MAX_WORDS: usize = DATAGRAM_MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        let datagram = encode_datagram(words);
        let Some(ends) = &self.ends else {
            return Err(LinkFull);
        };
        if self.backplane.cuts().is_cut(Wire::Link, self.of.system) {
            return Ok(());
        }
        let mut send = ends.send.lock().unwrap_or_else(PoisonError::into_inner);
        send.send(&datagram).map_err(|fifo::Full| LinkFull)
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        let mut receive = self
            .ends
            .as_ref()?
            .receive
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let datagram = receive.receive().ok()??;
        Some(decode_datagram(&datagram, words))
    }
}
