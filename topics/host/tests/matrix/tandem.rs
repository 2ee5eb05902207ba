//! Tandem's participant as a peer: a thread runs its node.

use crate::frame;
use crate::peer::{Reader, Writer};
use std::net::Ipv4Addr;
use std::sync::mpsc::{self, TryRecvError};
use std::thread::JoinHandle;
use std::time::Duration;
use tandem_board_udp::UdpPlace;
use tandem_topics::{Endpoint, Qos};
use tandem_topics_host::node::Node;

/// The longest wait of a node, after which it does what the test asks for.
const TURN: Duration = Duration::from_millis(1);

type Act<const W: usize, const R: usize> = Box<dyn FnOnce(&mut Driven<W, R>) + Send>;

/// A node, and what its reader has taken.
struct Driven<const W: usize, const R: usize> {
    node: Node<W, R>,
    taken: Vec<u32>,
}

/// A participant with `W` writers and `R` readers of the topic.
pub(crate) struct Tandem<const W: usize, const R: usize> {
    /// Acts that the thread of the node does. `None` when it shall end.
    acts: Option<mpsc::Sender<Act<W, R>>>,
    thread: Option<JoinHandle<()>>,
}

impl Tandem<1, 0> {
    pub(crate) fn writer(domain: u16, qos: Qos) -> Self {
        Self::open(domain, qos)
    }
}

impl Tandem<0, 1> {
    pub(crate) fn reader(domain: u16, qos: Qos) -> Self {
        Self::open(domain, qos)
    }
}

impl<const W: usize, const R: usize> Tandem<W, R> {
    fn open(domain: u16, qos: Qos) -> Self {
        let endpoint = Endpoint {
            topic: frame::TOPIC,
            type_name: frame::TYPE,
            qos,
        };
        let place = UdpPlace::new(domain, Ipv4Addr::LOCALHOST).unwrap();
        // A participant borrows its endpoints for ever: each cell is a process that ends soon.
        let (outputs, inputs) = (
            Box::leak(Box::new([endpoint; W])),
            Box::leak(Box::new([endpoint; R])),
        );
        let node = Node::open(place, outputs, inputs).unwrap();
        let taken = Vec::new();
        let mut driven = Driven { node, taken };
        let (acts, todo) = mpsc::channel::<Act<W, R>>();
        let thread = std::thread::spawn(move || {
            loop {
                driven.turn();
                match todo.try_recv() {
                    Ok(act) => act(&mut driven),
                    Err(TryRecvError::Empty) => {}
                    Err(TryRecvError::Disconnected) => return,
                }
            }
        });
        Self {
            acts: Some(acts),
            thread: Some(thread),
        }
    }

    /// Does something with the node, and returns the result.
    fn with<T: Send + 'static>(
        &self,
        act: impl FnOnce(&mut Driven<W, R>) -> T + Send + 'static,
    ) -> T {
        let (result, answer) = mpsc::channel();
        let act: Act<W, R> = Box::new(move |driven| result.send(act(driven)).unwrap());
        self.acts.as_ref().unwrap().send(act).unwrap();
        answer.recv().unwrap()
    }
}

impl<const W: usize, const R: usize> Driven<W, R> {
    fn turn(&mut self) {
        self.node.turn(TURN).unwrap();
        for reader in 0..R {
            let samples = std::iter::from_fn(|| self.node.take(reader));
            self.taken
                .extend(samples.map(|sample| frame::decode(sample.payload())));
        }
    }
}

impl<const W: usize, const R: usize> Drop for Tandem<W, R> {
    fn drop(&mut self) {
        self.acts = None;
        let _panicked = self.thread.take().map(JoinHandle::join);
    }
}

impl Writer for Tandem<1, 0> {
    fn write(&mut self, number: u32) -> bool {
        let payload = frame::encode(number);
        self.with(move |driven| driven.node.write(0, &payload))
            .is_ok()
    }

    fn incompatible(&mut self) -> u32 {
        self.with(|driven| driven.node.participant.writer_counts(0).incompatible)
    }

    fn refused(&mut self) -> u32 {
        self.with(|driven| driven.node.participant.writer_counts(0).refused)
    }
}

impl Reader for Tandem<0, 1> {
    fn take(&mut self) -> Vec<u32> {
        self.with(|driven| std::mem::take(&mut driven.taken))
    }

    fn incompatible(&mut self) -> u32 {
        self.with(|driven| driven.node.participant.reader_counts(0).incompatible)
    }

    fn lost(&mut self) -> Option<u32> {
        Some(self.with(|driven| driven.node.participant.reader_counts(0).lost))
    }
}
