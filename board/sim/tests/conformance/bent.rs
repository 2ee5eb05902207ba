//! A simulated board that breaks one contract: the conformance suite must find it.

mod network;
mod stamps;

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};
use std::sync::{Arc, Mutex, PoisonError};
use tandem_board::{
    Board, Can, CanErrors, CanFrame, CoreAddress, CoreId, DataFlash, Duration, Edge, FaultSource,
    FlashError, FlashStatus, Generation, HardwareFault, Identity, Instant, Line, Lines, Link,
    LinkFull, LmuWord, OutputDiagnosis, Received, ResetCause, ResetRequest, RoleLamp, Supply,
    SystemId, TimeEdge, TraceRecord, TransmitFull, Wake, watchdog_answer,
};
use tandem_board_sim::{Config, SimBoard};
use tandem_peripherals::data_flash::{ERASED, SIZE};

macro_rules! defects {
    ($($(#[doc = $doc:literal])+ $name:ident,)+) => {
        /// A way in which a board can break its contract.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(crate) enum Defect {
            $($(#[doc = $doc])+ $name,)+
            /// A fault of the hardware has no effect.
            FaultWithoutEffect(HardwareFault),
        }

        impl Defect {
            /// Returns all defects.
            pub(crate) fn all() -> impl Iterator<Item = Self> {
                let faults = HardwareFault::ALL.into_iter().map(Self::FaultWithoutEffect);
                [$(Self::$name),+].into_iter().chain(faults)
            }
        }
    };
}

defects! {
    /// A ring that arrives while the core is awake is lost.
    LostRing,
    /// A ring goes to the wrong core.
    MisdirectedRing,
    /// `wait` ends before its deadline.
    EarlyDeadline,
    /// `wait` returns `Deadline` for an interrupt.
    WrongWake,
    /// `wait` returns `Interrupt` for a deadline.
    SpuriousForEver,
    /// The clock sometimes goes backwards.
    ClockGoesBack,
    /// The cores of a system have different clocks.
    SkewedCores,
    /// Each core has a separate LMU.
    PrivateLmu,
    /// The systems share one LMU.
    OneLmu,
    /// The LMU is not zero at power-on.
    DirtyLmu,
    /// The generation does not begin at 1.
    WrongGeneration,
    /// All cores start together with core 0.
    NoneHeld,
    /// A release has no effect.
    NeverReleased,
    /// A release releases all cores.
    ReleasesAll,
    /// A core that is released twice starts twice.
    ReleasesAgain,
    /// A core receives the CAN frames that it sends.
    SelfReception,
    /// The other system does not receive this system's CAN frames.
    NoBroadcast,
    /// A discard of the waiting frames also discards the next frame.
    DiscardsLaterFrame,
    /// Two CAN frames are swapped.
    CanReordered,
    /// System B receives its own frames before those of system A.
    CanTwoOrders,
    /// The end of a long CAN FD frame is lost.
    FdTruncated,
    /// Lost CAN frames are not counted.
    OverrunNotCounted,
    /// A CAN frame is stamped when it is passed to the controller.
    StampAtOnce,
    /// A CAN frame is stamped when its stamp is read.
    StampLate,
    /// Every CAN frame is stamped.
    StampOfAny,
    /// A stamp of a CAN frame stays until the next one, even over a reset.
    StampStays,
    /// A received CAN frame does not wake the core.
    NoWakeOnReceive,
    /// A received CAN frame wakes a core that did not enable that.
    AlwaysWakeOnReceive,
    /// Falling edges are counted as rising ones.
    WrongEdge,
    /// Edges are counted at the sender.
    LineLoopback,
    /// An edge on the start line does not interrupt.
    SilentStart,
    /// The time line has an edge before one came.
    TimeEdgeTooSoon,
    /// An edge on the time line is stamped when it is read.
    TimeEdgeLate,
    /// A new edge on the time line changes the time before the count.
    TimeEdgeTorn,
    /// A reset forgets the newest edge on the time line.
    TimeEdgeForgotten,
    /// The level line does not show that the other system is on.
    LevelStuckLow,
    /// The level line does not fall.
    LevelStuckHigh,
    /// A change of the level line does not interrupt.
    SilentLevel,
    /// Words of two datagrams are mixed.
    LinkTorn,
    /// Datagrams overtake each other.
    LinkReordered,
    /// A full link drops datagrams silently.
    LinkDrops,
    /// The rest of a datagram that is too long for a receiver's buffer arrives as the next one.
    LinkSplits,
    /// Two datagrams of the network are swapped.
    NetworkReordered,
    /// A system hears what it sends to everyone.
    NetworkEchoes,
    /// What is sent to everyone is lost.
    NetworkHasNoGroup,
    /// All channels are one.
    NetworkHasOneChannel,
    /// A datagram has a wrong sender.
    NetworkHidesSender,
    /// The rest of a datagram that is too long for a receiver's buffer arrives as the next one.
    NetworkSplits,
    /// A datagram that was refused is sent later.
    NetworkSendsRefused,
    /// A datagram left before it was sent.
    NetworkLeavesEarly,
    /// The time of sending lies in the future.
    NetworkLeavesLate,
    /// A datagram arrived before it was sent.
    NetworkComesEarly,
    /// The time of receiving lies in the future.
    NetworkComesLate,
    /// An erased byte reads as zero.
    EraseToZero,
    /// Programming need not be aligned to pages.
    MisalignedProgram,
    /// An operation that is started while another one runs is accepted.
    NeverBusy,
    /// Programming sets bits.
    ProgramSets,
    /// An operation that a reset interrupts destroys the whole sector.
    ResetDisturbs,
    /// Programming a page disturbs the next page.
    ProgramDisturbs,
    /// A reset erases the flash.
    FlashForgets,
    /// The watchdog resets the system although it was serviced correctly.
    WatchdogRefuses,
    /// The watchdog always asks the same question.
    SameQuestion,
    /// A wrong answer to the watchdog has no effect.
    AnyAnswer,
    /// An early service is accepted.
    WindowIgnored,
    /// The window of the watchdog opens too late.
    WindowLate,
    /// A missing service has no effect.
    WatchdogSleeps,
    /// The reset cause is always power-on.
    CauseForgotten,
    /// The number of starts is always 1.
    StartsForgotten,
    /// A confirmed start changes nothing.
    StartUnconfirmed,
    /// A requested reset does not happen.
    RequestIgnored,
    /// Core 2 keeps its incarnation when the system is reset.
    PartialReset,
}

impl Defect {
    /// Changes the configuration of the simulated board if the defect is one of the watchdog.
    pub(crate) fn configure(self, config: &mut Config) {
        let window = &mut config.window;
        match self {
            Self::WindowIgnored => window.opens_us = 0,
            Self::WindowLate => window.opens_us += 1_000,
            Self::WatchdogSleeps => (window.closes_us, window.first_us) = (u32::MAX, u32::MAX),
            _ => {}
        }
    }
}

/// An LMU, aligned as a board must align it.
#[repr(align(64))]
struct Lmu([LmuWord; 8192]);

/// State that the bent boards of a pair share.
#[derive(Default)]
pub(crate) struct Common {
    waits: [AtomicBool; CoreAddress::COUNT],
    /// The core was released in this incarnation of the system.
    released: [AtomicBool; CoreAddress::COUNT],
    starts_again: [AtomicBool; CoreAddress::COUNT],
    lmus: Vec<Lmu>,
    /// Sent frames, each with its core.
    sent: Mutex<Vec<(CoreAddress, CanFrame)>>,
    /// The newest stamp of a frame.
    stamp: Mutex<Option<Instant>>,
    /// Edges that arrived at each system without an interrupt.
    edges: [[[AtomicU32; 2]; Line::ALL.len()]; 2],
    flash: [Mutex<Medium>; 2],
}

impl Common {
    pub(crate) fn new(defect: Option<Defect>) -> Self {
        let has_lmus = matches!(defect, Some(Defect::PrivateLmu | Defect::OneLmu));
        let lmus = if has_lmus { CoreAddress::COUNT } else { 0 };
        let zero = |_| Lmu([const { LmuWord::new(0) }; 8192]);
        Self {
            lmus: (0..lmus).map(zero).collect(),
            ..Self::default()
        }
    }
}

/// The panic payload that ends a role when its core starts again.
struct StartsAgain;

/// The bytes that a bent flash returns instead of those of the simulated flash.
struct Medium {
    shown: Vec<Option<u8>>,
    /// The operation in progress, as far as core 0 knows.
    under_way: Option<usize>,
}

impl Default for Medium {
    fn default() -> Self {
        Self {
            shown: vec![None; SIZE],
            under_way: None,
        }
    }
}

/// The interface of one core of a simulated board with a defect, for one incarnation of that core.
pub(crate) struct Bent {
    board: SimBoard,
    defect: Option<Defect>,
    common: Arc<Common>,
    readings: Cell<u32>,
    level: Cell<bool>,
    loses_next: Cell<bool>,
    frames: RefCell<VecDeque<Received>>,
    received: Cell<u32>,
    time_edges: Cell<u32>,
    datagrams: RefCell<VecDeque<Vec<u32>>>,
    packets: RefCell<VecDeque<network::Held>>,
    refused: RefCell<Vec<network::Held>>,
}

impl Bent {
    pub(crate) fn new(board: &SimBoard, defect: Option<Defect>, common: &Arc<Common>) -> Self {
        let bent = Self {
            board: board.clone(),
            defect,
            common: Arc::clone(common),
            readings: Cell::default(),
            level: Cell::new(board.lines().peer_powered()),
            loses_next: Cell::default(),
            frames: RefCell::default(),
            received: Cell::default(),
            time_edges: Cell::default(),
            datagrams: RefCell::default(),
            packets: RefCell::default(),
            refused: RefCell::default(),
        };
        if bent.is(Defect::AlwaysWakeOnReceive) {
            board.can().wake_on_receive(true);
        }
        if bent.place().core == CoreId::CONTROL {
            bent.start_system();
        }
        bent
    }

    fn start_system(&self) {
        for core in CoreId::ALL {
            let core = CoreAddress::new(self.place().system, core);
            self.common.released[core.index()].store(false, SeqCst);
        }
        let is_first = self.board.identity().generation.0 == 1;
        if self.is(Defect::DirtyLmu) && is_first {
            let lmu = self.board.lmu();
            lmu[lmu.len() - 7].store(1, SeqCst);
        }
        if self.is(Defect::NoneHeld) {
            self.release_others();
        }
        let mut medium = self.medium();
        let interrupted = medium.under_way.take();
        if self.is(Defect::FlashForgets) && !is_first {
            medium.shown.fill(Some(ERASED));
        }
        if let (true, Some(at)) = (self.is(Defect::ResetDisturbs), interrupted) {
            let begin = at - at % Self::SECTOR_BYTES as usize;
            medium.shown[begin..][..Self::SECTOR_BYTES as usize].fill(Some(0x5A));
        }
    }

    fn is(&self, defect: Defect) -> bool {
        self.defect == Some(defect)
    }

    fn place(&self) -> CoreAddress {
        self.board.identity().address()
    }

    fn medium(&self) -> std::sync::MutexGuard<'_, Medium> {
        let medium = &self.common.flash[self.place().system.index()];
        medium.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn release_others(&self) {
        self.board.release_core(CoreId::PERCEPTION);
        self.board.release_core(CoreId::PLANNING);
    }

    /// Runs the role of the core, and starts it from the beginning whenever the core starts again.
    pub(crate) fn play<R>(&self, role: impl Fn(&Self) -> R) -> R {
        loop {
            match catch_unwind(AssertUnwindSafe(|| role(self))) {
                Ok(result) => return result,
                Err(panic) if panic.is::<StartsAgain>() => {}
                Err(panic) => resume_unwind(panic),
            }
        }
    }

    fn edges(&self, at: SystemId, line: Line, edge: Edge) -> &AtomicU32 {
        &self.common.edges[at.index()][line.index()][edge as usize]
    }

    /// Returns the core that last sent a frame with this content.
    fn sender(&self, frame: &CanFrame) -> Option<CoreAddress> {
        let sent = self.common.sent.lock().unwrap();
        let mut same = sent.iter().rev().filter(|(_, other)| other == frame);
        same.next().map(|(from, _)| *from)
    }

    /// Takes the frames out of the receiver, and applies the defects of order and reception.
    fn fetch(&self) {
        let here = self.place();
        let mut frames = self.frames.borrow_mut();
        while let Some(mut received) = self.board.can().try_receive() {
            let sender = || self.sender(&received.frame);
            if self.is(Defect::NoBroadcast) && sender().is_some_and(|it| it.system != here.system) {
                continue;
            }
            let count = self.received.replace(self.received.get() + 1);
            let swaps = self.is(Defect::CanReordered) && count.is_multiple_of(5)
                || self.is(Defect::CanTwoOrders)
                    && here.system == SystemId::B
                    && sender() == Some(CoreAddress::B0);
            if self.is(Defect::FdTruncated) {
                received.frame = truncated(&received.frame);
            }
            frames.push_back(received);
            if let (true, Some(before)) = (swaps, frames.len().checked_sub(2)) {
                frames.swap(before, before + 1);
            }
        }
    }

    /// Takes the datagrams out of the link, and applies the defects of the link.
    fn fetch_datagrams(&self) {
        let mut buffer = [0; <Self as Link>::MAX_WORDS];
        let mut datagrams = self.datagrams.borrow_mut();
        while let Some(len) = self.board.link().try_receive(&mut buffer) {
            let mut datagram = buffer[..len].to_vec();
            if let (true, Some(last)) = (self.is(Defect::LinkTorn), datagrams.back_mut()) {
                let half = last.len().min(len) / 2;
                last[..half].swap_with_slice(&mut datagram[..half]);
            }
            datagrams.push_back(datagram);
            if self.is(Defect::LinkReordered) {
                datagrams.make_contiguous().reverse();
            }
        }
    }

    /// Begins a flash operation at this place, if the simulated flash accepts it.
    fn begin(&self, at: usize, started: Result<(), FlashError>) -> Result<(), FlashError> {
        match started {
            Ok(()) => self.medium().under_way = Some(at),
            Err(FlashError::Busy) if self.is(Defect::NeverBusy) => return Ok(()),
            Err(error) => return Err(error),
        }
        Ok(())
    }
}

fn truncated(frame: &CanFrame) -> CanFrame {
    let kept = frame.data().len().min(8);
    CanFrame::new(frame.id(), frame.is_fd(), &frame.data()[..kept]).unwrap()
}

impl Board for Bent {
    type Can = Self;
    type Lines = Self;
    type Link = Self;
    type Network = Self;
    type Flash = Self;
    type Supply = Self;

    fn identity(&self) -> Identity {
        let mut identity = self.board.identity();
        if self.is(Defect::WrongGeneration) {
            identity.generation.0 += 1;
        }
        if self.is(Defect::PartialReset) && identity.core == CoreId::PLANNING {
            identity.generation = Generation(1);
        }
        identity
    }

    fn now(&self) -> Instant {
        let count = self.readings.replace(self.readings.get().wrapping_add(1));
        let behind_ns = match self.defect {
            Some(Defect::ClockGoesBack) if count.is_multiple_of(7) => 1_000_000,
            Some(Defect::SkewedCores) => 200_000 * self.place().core.index() as u64,
            _ => 0,
        };
        Instant::from_ns(self.board.now().as_ns().saturating_sub(behind_ns))
    }

    fn lmu(&self) -> &[LmuWord] {
        match self.defect {
            Some(Defect::PrivateLmu) => &self.common.lmus[self.place().index()].0,
            Some(Defect::OneLmu) => &self.common.lmus[0].0,
            _ => self.board.lmu(),
        }
    }

    fn ring(&self, to: CoreId) {
        let receiver = CoreAddress::new(self.place().system, to);
        let waits = self.common.waits[receiver.index()].load(SeqCst);
        match self.defect {
            Some(Defect::LostRing) if !waits => {}
            Some(Defect::MisdirectedRing) => {
                self.board
                    .ring(CoreId::ALL[(to.index() + 1) % CoreId::COUNT]);
            }
            _ => self.board.ring(to),
        }
    }

    fn release_core(&self, core: CoreId) {
        match self.defect {
            Some(Defect::NeverReleased) => {}
            Some(Defect::ReleasesAll) => self.release_others(),
            _ => self.board.release_core(core),
        }
        let released = CoreAddress::new(self.place().system, core);
        let again = self.common.released[released.index()].swap(true, SeqCst);
        if self.is(Defect::ReleasesAgain) && again {
            self.common.starts_again[released.index()].store(true, SeqCst);
        }
    }

    fn wait(&self, deadline: Instant) -> Wake {
        let now = self.board.now();
        let halfway = now + Duration::from_ns(deadline.since(now).as_ns() / 2);
        let until = match self.is(Defect::EarlyDeadline) {
            true => halfway,
            false => deadline,
        };
        let waits = &self.common.waits[self.place().index()];
        loop {
            waits.store(true, SeqCst);
            let wake = self.board.wait(until);
            let level = self.board.lines().peer_powered();
            if self.is(Defect::SilentLevel)
                && self.level.replace(level) != level
                && wake == Wake::Interrupt
            {
                continue;
            }
            waits.store(false, SeqCst);
            if self.common.starts_again[self.place().index()].swap(false, SeqCst) {
                resume_unwind(Box::new(StartsAgain));
            }
            return match self.defect {
                Some(Defect::WrongWake) => Wake::Deadline,
                Some(Defect::SpuriousForEver) => Wake::Interrupt,
                _ => wake,
            };
        }
    }

    fn can(&self) -> &Self {
        self
    }

    fn lines(&self) -> &Self {
        self
    }

    fn link(&self) -> &Self {
        self
    }

    fn network(&self) -> &Self {
        self
    }

    fn flash(&self) -> &Self {
        self
    }

    fn supply(&self) -> &Self {
        self
    }

    fn output_diagnosis(&self) -> OutputDiagnosis {
        self.board.output_diagnosis()
    }

    fn trace(&self, record: TraceRecord) {
        self.board.trace(record);
    }
}

impl FaultSource for Bent {
    fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool) {
        if !self.is(Defect::FaultWithoutEffect(fault)) {
            self.board.set_fault(of, fault, present);
        }
    }
}

impl Can for Bent {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        if self.loses_next.take() {
            return Ok(());
        }
        let place = self.place();
        if matches!(
            self.defect,
            Some(Defect::NoBroadcast | Defect::CanTwoOrders)
        ) {
            self.common.sent.lock().unwrap().push((place, *frame));
        }
        match self.is(Defect::StampOfAny) {
            true => self.board.can().try_send_stamped(frame)?,
            false => self.board.can().try_send(frame)?,
        }
        if self.is(Defect::SelfReception) {
            let (frame, at) = (*frame, self.board.now());
            self.frames.borrow_mut().push_back(Received { frame, at });
        }
        Ok(())
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send_stamped(frame)
    }

    fn stamp(&self) -> Option<Instant> {
        self.bent_stamp()
    }

    fn discard_unsent(&self) {
        self.board.can().discard_unsent();
        self.loses_next.set(self.is(Defect::DiscardsLaterFrame));
    }

    fn try_receive(&self) -> Option<Received> {
        let bends = matches!(
            self.defect,
            Some(
                Defect::SelfReception
                    | Defect::NoBroadcast
                    | Defect::CanReordered
                    | Defect::CanTwoOrders
                    | Defect::FdTruncated
            )
        );
        if !bends {
            return self.board.can().try_receive();
        }
        self.fetch();
        self.frames.borrow_mut().pop_front()
    }

    fn wake_on_receive(&self, on: bool) {
        match self.defect {
            Some(Defect::NoWakeOnReceive | Defect::AlwaysWakeOnReceive) => {}
            _ => self.board.can().wake_on_receive(on),
        }
    }

    fn overruns(&self) -> u32 {
        match self.is(Defect::OverrunNotCounted) {
            true => 0,
            false => self.board.can().overruns(),
        }
    }

    fn errors(&self) -> CanErrors {
        self.board.can().errors()
    }
}

impl Lines for Bent {
    fn send(&self, line: Line, edge: Edge) {
        let here = self.place().system;
        let to = match self.defect {
            Some(Defect::LineLoopback) => here,
            Some(Defect::SilentStart) if line == Line::Start => here.peer(),
            _ => return self.board.lines().send(line, edge),
        };
        self.edges(to, line, edge).fetch_add(1, SeqCst);
    }

    fn received(&self, line: Line, edge: Edge) -> u32 {
        let lines = self.board.lines();
        let count = |edge| lines.received(line, edge);
        match (self.defect, edge) {
            (Some(Defect::WrongEdge), Edge::Rising) => count(Edge::Rising) + count(Edge::Falling),
            (Some(Defect::WrongEdge), Edge::Falling) => 0,
            _ => count(edge) + self.edges(self.place().system, line, edge).load(SeqCst),
        }
    }

    fn time_edge(&self) -> Option<TimeEdge> {
        self.bent_time_edge()
    }

    fn peer_powered(&self) -> bool {
        let level = self.board.lines().peer_powered();
        match self.defect {
            Some(Defect::LevelStuckLow) => false,
            Some(Defect::LevelStuckHigh) => true,
            _ => level,
        }
    }
}

impl Link for Bent {
    const MAX_WORDS: usize = <SimBoard as Board>::Link::MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        let sent = self.board.link().try_send(words);
        match self.is(Defect::LinkDrops) {
            true => Ok(()),
            false => sent,
        }
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        let bends = matches!(
            self.defect,
            Some(Defect::LinkTorn | Defect::LinkReordered | Defect::LinkSplits)
        );
        if !bends {
            return self.board.link().try_receive(words);
        }
        self.fetch_datagrams();
        let mut datagrams = self.datagrams.borrow_mut();
        let datagram = datagrams.pop_front()?;
        let len = datagram.len().min(words.len());
        words[..len].copy_from_slice(&datagram[..len]);
        if self.is(Defect::LinkSplits) && len < datagram.len() {
            datagrams.push_front(datagram[len..].to_vec());
        }
        Some(len)
    }
}

impl DataFlash for Bent {
    const PAGE_BYTES: u32 = <SimBoard as Board>::Flash::PAGE_BYTES;
    const SECTOR_BYTES: u32 = <SimBoard as Board>::Flash::SECTOR_BYTES;
    const SECTORS: u32 = <SimBoard as Board>::Flash::SECTORS;

    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        self.board.flash().read(offset, into)?;
        let medium = self.medium();
        for (byte, shown) in into.iter_mut().zip(&medium.shown[offset as usize..]) {
            *byte = shown.unwrap_or(*byte);
            if self.is(Defect::EraseToZero) && *byte == ERASED {
                *byte = 0;
            }
        }
        Ok(())
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        let at = (sector * Self::SECTOR_BYTES) as usize;
        self.begin(at, self.board.flash().start_erase(sector))?;
        self.medium().shown[at..][..Self::SECTOR_BYTES as usize].fill(None);
        Ok(())
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        let offset = match self.is(Defect::MisalignedProgram) {
            true => offset & !(Self::PAGE_BYTES - 1),
            false => offset,
        };
        let started = self.board.flash().start_program(offset, data);
        self.begin(offset as usize, started)?;
        let behind = offset as usize + data.len();
        let shown = &mut self.medium().shown;
        if self.is(Defect::ProgramSets) {
            for (shown, byte) in shown[offset as usize..behind].iter_mut().zip(data) {
                *shown = Some(*byte);
            }
        }
        if self.is(Defect::ProgramDisturbs) {
            shown[behind..(behind + Self::PAGE_BYTES as usize).min(SIZE)].fill(Some(0));
        }
        Ok(())
    }

    fn status(&self) -> FlashStatus {
        let status = self.board.flash().status();
        if status == FlashStatus::Idle {
            self.medium().under_way = None;
        }
        status
    }
}

impl Supply for Bent {
    const WINDOW_OPENS_US: u32 = <SimBoard as Board>::Supply::WINDOW_OPENS_US;
    const WINDOW_CLOSES_US: u32 = <SimBoard as Board>::Supply::WINDOW_CLOSES_US;
    const FIRST_SERVICE_US: u32 = <SimBoard as Board>::Supply::FIRST_SERVICE_US;

    fn reset_cause(&self) -> ResetCause {
        match self.is(Defect::CauseForgotten) {
            true => ResetCause::PowerOn,
            false => self.board.supply().reset_cause(),
        }
    }

    fn starts(&self) -> u8 {
        match self.is(Defect::StartsForgotten) {
            true => 1,
            false => self.board.supply().starts(),
        }
    }

    fn confirm_start(&self) {
        if !self.is(Defect::StartUnconfirmed) {
            self.board.supply().confirm_start();
        }
    }

    fn watchdog_question(&self) -> u8 {
        match self.is(Defect::SameQuestion) {
            true => 0,
            false => self.board.supply().watchdog_question(),
        }
    }

    fn service_watchdog(&self, answer: u8) {
        let supply = self.board.supply();
        let question = supply.watchdog_question();
        let right = watchdog_answer(question);
        supply.service_watchdog(match self.defect {
            Some(Defect::AnyAnswer) => right,
            Some(Defect::SameQuestion) if answer == watchdog_answer(0) => right,
            Some(Defect::WatchdogRefuses) if question == 8 => !answer,
            _ => answer,
        });
    }

    fn request_reset(&self, request: ResetRequest) {
        if !self.is(Defect::RequestIgnored) {
            self.board.supply().request_reset(request);
        }
    }

    fn show_role(&self, lamp: RoleLamp) {
        self.board.supply().show_role(lamp);
    }
}
