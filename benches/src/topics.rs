//! Topics: a CAN frame by each transport of `tandem_shm::topic`, and by a bare UDP socket. D-2
//!
//! A sample is half of a round trip, as `ddsperf` counts. All receivers sleep in the kernel: those
//! of UDP and DDS for a datagram on the loopback interface, those in shared memory for a doorbell.

use crate::harness::{Batch, BatchPlan, End, between_processes, next_run};
use crate::peers::ddsperf::domain;
use crate::peers::iceoryx2;
use crate::shared::announce;
use crate::tandem::Meeting;
use rustix::event::{PollFd, PollFlags, poll};
use std::io;
use std::net::{Ipv4Addr, UdpSocket};
use std::time::Duration;
use tandem_board::{Board, CoreId};
use tandem_board_host::{HostBoard, RunName};
use tandem_board_udp::UdpPlace;
use tandem_observers::{Frame, ServicePublisher, ServiceSubscriber};
use tandem_shm::broadcast::Writer;
use tandem_shm::mailbox::{Receiver, Ring, Sender, TaskId};
use tandem_shm::map::Layout;
use tandem_shm::region::{Broadcast, Mailbox, Region};
use tandem_shm::topic::{Publish, RingSubscriber, Subscribe};
use tandem_shm::wait::{Awaited, WaitPolicy};
use tandem_topics::{CanFrame, Durability, Endpoint, Qos, Reliability, TopicType};
use tandem_topics_host::node::Node;
use tandem_topics_host::typed::{TypedReader, TypedWriter};

/// Returns the frame that carries a stamp.
fn frame(stamp: u32) -> CanFrame {
    CanFrame {
        id: stamp,
        period_ms: 10,
        length: 64,
        data: [stamp as u8; 64],
    }
}

/// Returns the stamp of a frame.
///
/// # Panics
/// If a byte is not what was written.
fn stamp_of(frame: &CanFrame) -> u32 {
    assert_eq!(frame.data, [frame.id as u8; 64], "a frame arrived torn");
    frame.id
}

/// Counts half of each round trip as a sample.
fn halves(batch: Batch) -> Batch {
    Batch {
        samples_ps: batch.round_trips_ps.iter().map(|ps| ps / 2).collect(),
        ..batch
    }
    .carrying(CanFrame::PAYLOAD_LEN as u64)
}

/// Takes the next value; `wait` sleeps until there may be one.
fn next<T>(from: &mut impl Subscribe<T>, mut wait: impl FnMut()) -> T {
    loop {
        if let Some(value) = from.take() {
            return value;
        }
        wait();
    }
}

/// A datagram of the same length between two sockets; the receiver sleeps in `poll`.
pub(crate) fn udp_floor(plan: &BatchPlan) -> io::Result<Batch> {
    let open = || UdpSocket::bind((Ipv4Addr::LOCALHOST, 0));
    let sockets = [open()?, open()?];
    for (socket, peer) in [(0, 1), (1, 0)] {
        sockets[socket].connect(sockets[peer].local_addr()?)?;
    }
    let batch = between_processes(plan, |_, [own, _]| {
        let socket = &sockets[own];
        let send = move |stamp: u32| {
            let mut bytes = [0; CanFrame::PAYLOAD_LEN];
            bytes[..4].copy_from_slice(&stamp.to_ne_bytes());
            socket.send(&bytes).expect("a datagram is sent");
        };
        let receive = move || {
            let mut bytes = [0; CanFrame::PAYLOAD_LEN];
            // A signal ends the wait too; the socket blocks then.
            let _ = poll(&mut [PollFd::new(socket, PollFlags::IN)], None);
            let length = socket.recv(&mut bytes).expect("a datagram arrives");
            assert_eq!(length, bytes.len());
            bytes
                .first_chunk()
                .map_or(0, |first| u32::from_ne_bytes(*first))
        };
        (send, receive)
    })?;
    Ok(halves(batch))
}

const QOS: Qos = Qos {
    reliability: Reliability::Reliable,
    durability: Durability::TransientLocal,
    depth: 3,
};
const THERE: Endpoint = Endpoint {
    topic: "tandem_bench_there",
    type_name: CanFrame::TYPE_NAME,
    qos: QOS,
};
const BACK: Endpoint = Endpoint {
    topic: "tandem_bench_back",
    ..THERE
};
/// What the node of each end writes and reads.
static WAYS: [[Endpoint; 1]; 2] = [[THERE], [BACK]];

/// The longest wait of a node. It also wakes for what it announces.
const TURN: Duration = Duration::from_secs(1);

/// From node to node over DDS, reliable, on the loopback interface.
pub(crate) fn dds(plan: &BatchPlan) -> io::Result<Batch> {
    let place = UdpPlace::new(domain(), Ipv4Addr::LOCALHOST).map_err(io::Error::other)?;
    let batch = between_processes(plan, |_, [out, inward]| {
        let node = Node::open(place, &WAYS[out], &WAYS[inward]).expect("sockets of the domain");
        let mut end = NodeEnd(node);
        while end.0.participant.readers_of(0) == 0
            || end.0.participant.writers_of(0).next().is_none()
        {
            end.0.turn(TURN).expect("sockets that work");
        }
        end
    })?;
    Ok(halves(batch))
}

struct NodeEnd(Node<1, 1>);

impl End for NodeEnd {
    fn send(&mut self, stamp: u32) {
        let published = TypedWriter::new(&mut self.0, 0).publish(&frame(stamp));
        published.expect("a frame that is valid");
    }

    fn receive(&mut self) -> u32 {
        loop {
            let mut reader = TypedReader::<_, CanFrame, 1, 1>::new(&mut self.0, 0);
            if let Some(frame) = reader.take() {
                return stamp_of(&frame);
            }
            self.0.turn(TURN).expect("sockets that work");
        }
    }
}

/// What leads to a core: signals, and frames.
type Inward = (Region<Mailbox>, Region<Broadcast<CanFrame, 8>>);
const SIGNALS: Region<Mailbox> = Region::first("signals there");
const FRAMES: Inward = (SIGNALS, SIGNALS.then("frames there"));
const SIGNALS_BACK: Region<Mailbox> = FRAMES.1.then("signals back");
const FRAMES_BACK: Inward = (SIGNALS_BACK, SIGNALS_BACK.then("frames back"));
const LAYOUT: Layout = FRAMES_BACK.1.end();

/// A core's end of both ways.
struct CoreEnd {
    board: &'static HostBoard,
    peer: CoreId,
    frames_out: Writer<'static, CanFrame>,
    signal_out: Sender<'static>,
    waiting: Waiting,
}

/// The condition of a waiting core: a frame.
struct Waiting {
    board: &'static HostBoard,
    signals: Receiver<'static>,
    frames: RingSubscriber<'static, CanFrame>,
}

impl Awaited for Waiting {
    type Output = CanFrame;

    fn check(&mut self) -> Option<CanFrame> {
        self.signals.poll(|_| {});
        self.frames.take()
    }

    fn prepare_sleep(&mut self) -> bool {
        self.signals.prepare_sleep()
    }

    fn sleep(&mut self) {
        let until = self.board.now() + tandem_board::Duration::from_ms(100);
        self.board.wait(until);
    }

    fn awake(&mut self) {
        self.signals.awake();
    }
}

impl End for CoreEnd {
    fn send(&mut self, stamp: u32) {
        let Ok(()) = Publish::publish(&mut self.frames_out, &frame(stamp));
        if self.signal_out.signal(TaskId::FIRST) == Ring::Needed {
            self.board.ring(self.peer);
        }
    }

    fn receive(&mut self) -> u32 {
        stamp_of(&WaitPolicy::Sleep.wait(&mut self.waiting))
    }
}

/// From core to core through a ring in the LMU, with a signal and a doorbell.
pub(crate) fn lmu(plan: &BatchPlan) -> io::Result<Batch> {
    let meeting = Meeting::new(plan, LAYOUT);
    let batch = between_processes(plan, |shared, [out, inward]| {
        let cores = [CoreId::PERCEPTION, CoreId::PLANNING];
        let (board, map) = meeting.attach(shared, cores[out]);
        let own = announce(&map, cores[out].index(), meeting.incarnation);
        let ways = [FRAMES, FRAMES_BACK];
        CoreEnd {
            board,
            peer: cores[inward],
            frames_out: ways[out].1.writer(&map, own).expect("it is free"),
            signal_out: ways[out].0.sender(&map, own).expect("it is free"),
            waiting: Waiting {
                board,
                signals: ways[inward].0.receiver(&map, own).expect("it is free"),
                frames: RingSubscriber::new(ways[inward].1.receiver(&map).expect("it fits")),
            },
        }
    })?;
    Ok(halves(batch))
}

/// From process to process by the service of CAN frames, with an event of default settings.
pub(crate) fn services(plan: &BatchPlan) -> io::Result<Batch> {
    let run = next_run();
    let runs = [0, 1].map(|way| {
        let name = format!("tandem-bench-{run}-{way}").parse::<RunName>();
        name.expect("the name of a run")
    });
    let batch = between_processes(plan, |shared, ways| {
        let [out, inward] = ways.map(|way| &runs[way]);
        let mut frames_out = ServicePublisher::<Frame>::create(out).expect("a new service");
        shared.meet(2);
        let mut frames_in = ServiceSubscriber::<Frame>::on(inward).expect("its service");
        let (mut ring, mut wait) = iceoryx2::bells(run, ways);
        let send = move |stamp: u32| {
            let frame = Frame::new(0, stamp, 2, 0, &[stamp as u8; 64]);
            frames_out.publish(&frame).expect("a sample is free");
            ring();
        };
        let receive = move || {
            let frame = next(&mut frames_in, &mut wait);
            assert_eq!(frame.data, [frame.id as u8; 64], "a frame arrived torn");
            frame.id
        };
        (send, receive)
    })?;
    Ok(halves(batch).carrying(size_of::<Frame>() as u64))
}
