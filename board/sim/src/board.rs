//! The simulated machine as one core sees it.

use crate::baton::Baton;
use crate::event::SystemEventKind;
use crate::flash_medium::Flash;
use crate::machine::{Attention, Machine, Shared};
use crate::outbox::Output;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use tandem_board::{
    Board, Can, CanErrors, CanFrame, CanId, CoreAddress, CoreId, DataFlash, Edge, FaultSource,
    FlashError, FlashStatus, Generation, HardwareFault, Identity, Instant, Line, Lines, Link,
    LinkFull, LmuWord, OutputDiagnosis, Received, ResetCause, ResetRequest, RoleLamp, Supply,
    SystemId, TimeEdge, TraceRecord, Traced, TransmitFull, Wake,
};
use tandem_peripherals::codec::DATAGRAM_MAX_WORDS;
use tandem_peripherals::data_flash;
use tandem_peripherals::watchdog::Window;

/// A core's code: called when its interrupt is pending or its deadline has passed. Returns its next
/// deadline on its system's clock.
pub type Poller = Box<dyn FnMut(&SimBoard) -> Instant>;

/// A core's connection to the machine, for one incarnation of the core.
#[derive(Clone)]
pub struct SimPort {
    pub(crate) shared: Arc<Shared>,
    pub(crate) place: CoreAddress,
    pub(crate) generation: Generation,
    pub(crate) incarnation: u64,
    pub(crate) baton: Option<Arc<Baton>>,
}

impl SimPort {
    /// Runs `act` if this incarnation of the core is still current: a dead core must not act.
    pub(crate) fn alive<R>(&self, act: impl FnOnce(&mut Machine) -> R) -> Option<R> {
        let mut machine = self.shared.lock();
        let core = machine.core(self.place);
        let incarnations = core.alive && core.incarnation == self.incarnation;
        incarnations.then(|| act(&mut machine))
    }

    /// Charges a blocking core virtual time for reading something that may change; the other cores
    /// run in that time.
    #[inline]
    pub(crate) fn look(&self) {
        if let Some(baton) = &self.baton {
            self.pay_for_look(baton);
        }
    }

    fn pay_for_look(&self, baton: &Baton) {
        let pays = self.shared.config.look_at_clock;
        if pays.as_ns() > 0 {
            let until = self.shared.glance.local(self.place.system) + pays;
            baton.park(until);
        }
    }

    fn wait(&self, deadline: Instant) -> Wake {
        let Some(baton) = &self.baton else {
            panic!("a polled core cannot wait; see `blocking`")
        };
        if let Some(wake) = self.woken(deadline) {
            self.look();
            return wake;
        }
        loop {
            baton.park(deadline);
            self.awake();
            if let Some(wake) = self.woken(deadline) {
                return wake;
            }
        }
    }

    /// Returns why a wait must end now. If there is no reason, marks the core as waiting.
    fn woken(&self, deadline: Instant) -> Option<Wake> {
        let mut machine = self.shared.lock();
        let now = machine.local(self.place.system);
        let core = machine.core(self.place);
        let pending = core.incarnation == self.incarnation && core::mem::take(&mut core.pending);
        if !pending && now < deadline {
            core.attention = Attention::Waits;
            return None;
        }
        Some(match pending {
            true => Wake::Interrupt,
            false => Wake::Deadline,
        })
    }

    fn awake(&self) {
        self.alive(|machine| machine.core(self.place).attention = Attention::Runs);
    }

    pub(crate) fn is_control(&self) -> bool {
        self.place.core == CoreId::CONTROL
    }
}

/// The interface of one core of a [`SimPair`](crate::SimPair), for one incarnation of that core.
///
/// After that incarnation has ended (power lost, reset, core killed), a board that is still held
/// sends nothing.
///
/// # Panics
/// `wait` panics on a core that is polled. Programming the flash and servicing the watchdog panic
/// on a core other than core 0.
#[derive(Clone)]
pub struct SimBoard {
    pub(crate) port: SimPort,
    link: SimLink,
    network: SimNetwork,
}

/// A system's end of the data link.
#[derive(Clone)]
pub struct SimLink(SimPort);

/// The Ethernet port of core 0; on the other cores it is not connected.
#[derive(Clone)]
pub struct SimNetwork(pub(crate) SimPort);

impl SimBoard {
    pub(crate) fn new(port: SimPort) -> Self {
        Self {
            link: SimLink(port.clone()),
            network: SimNetwork(port.clone()),
            port,
        }
    }

    pub(crate) fn with_baton(&self, baton: Arc<Baton>) -> Self {
        self.port.awake();
        Self::new(SimPort {
            baton: Some(baton),
            ..self.port.clone()
        })
    }
}

/// Used by an executor that models the run time of jobs.
impl SimBoard {
    /// Assigns further outputs of this core to this job: they are sent by [`SimBoard::let_go`].
    /// With `None` they are sent at once.
    pub fn hold(&self, job: Option<u8>) {
        self.port
            .alive(|machine| machine.core(self.port.place).job = job);
    }

    /// Sends the outputs of this job, in order.
    pub fn let_go(&self, job: u8) {
        let place = self.port.place;
        self.port.alive(|machine| {
            let held = core::mem::take(&mut machine.core(place).outbox);
            let (gone, held) = held.into_iter().partition(|(of, _)| *of == job);
            machine.core(place).outbox = held;
            let gone: Vec<(u8, Output)> = gone;
            for (_, output) in gone {
                machine.put_out(place, output);
            }
        });
    }

    /// Returns whether an interrupt caused the present call of this core.
    #[must_use]
    pub fn is_interrupted(&self) -> bool {
        let called = self
            .port
            .alive(|machine| machine.core(self.port.place).interrupted);
        called.unwrap_or(false)
    }

    /// Returns whether a frame with this identifier waits in the receiver of this core.
    #[must_use]
    pub fn has_received(&self, id: CanId) -> bool {
        let waits = self.port.alive(|machine| {
            let mut waiting = machine.core(self.port.place).can_fifo.iter();
            waiting.any(|received| received.frame.id() == id)
        });
        waits.unwrap_or(false)
    }

    /// Returns a random number below `limit`, drawn from the seed of the run; 0 if `limit` is 0.
    #[must_use]
    pub fn draw_below(&self, limit: u64) -> u64 {
        self.port.shared.lock().draw_below(limit)
    }
}

impl Board for SimBoard {
    type Can = SimPort;
    type Lines = SimPort;
    type Link = SimLink;
    type Network = SimNetwork;
    type Flash = SimPort;
    type Supply = SimPort;

    fn identity(&self) -> Identity {
        let CoreAddress { system, core } = self.port.place;
        Identity {
            system,
            core,
            generation: self.port.generation,
        }
    }

    #[inline]
    fn now(&self) -> Instant {
        self.port.look();
        let SimPort { shared, place, .. } = &self.port;
        shared.glance.local(place.system)
    }

    fn lmu(&self) -> &[LmuWord] {
        self.port.shared.lmu(self.port.place.system)
    }

    fn ring(&self, to: CoreId) {
        self.port
            .alive(|machine| machine.ring(self.port.place.system, to));
    }

    fn release_core(&self, core: CoreId) {
        assert!(self.port.is_control(), "only core 0 releases cores");
        let system = self.port.place.system;
        self.port
            .alive(|machine| machine.release(CoreAddress { system, core }));
    }

    fn output_diagnosis(&self) -> OutputDiagnosis {
        let mut machine = self.port.shared.lock();
        machine.conditions().hardware[self.port.place.system.index()].outputs()
    }

    fn wait(&self, deadline: Instant) -> Wake {
        self.port.wait(deadline)
    }

    fn can(&self) -> &SimPort {
        &self.port
    }

    fn lines(&self) -> &SimPort {
        &self.port
    }

    fn link(&self) -> &SimLink {
        &self.link
    }

    fn network(&self) -> &SimNetwork {
        &self.network
    }

    fn flash(&self) -> &SimPort {
        &self.port
    }

    fn supply(&self) -> &SimPort {
        &self.port
    }

    #[inline]
    fn trace(&self, record: TraceRecord) {
        if self.port.shared.config.trace_records == 0 {
            return;
        }
        self.port.alive(|machine| {
            let CoreAddress { system, core } = self.port.place;
            if machine.trace.len() < machine.config.trace_records {
                let at = machine.at();
                machine.trace.push(Traced {
                    at,
                    system,
                    core,
                    record,
                });
            } else {
                machine.trace_lost += 1;
            }
        });
    }
}

impl FaultSource for SimBoard {
    fn set_fault(&self, of: SystemId, fault: HardwareFault, present: bool) {
        let mut machine = self.port.shared.lock();
        machine.set_fault(of, fault, present);
    }
}

impl SimPort {
    /// Passes a frame to the controller, with the mark that `mark` returns.
    fn send_frame(
        &self,
        frame: &CanFrame,
        mark: impl FnOnce(&mut Machine) -> u32,
    ) -> Result<(), TransmitFull> {
        let sent = self
            .alive(|machine| {
                let mark = mark(machine);
                if machine.holds(self.place, || Output::Frame(*frame, mark)) {
                    return Ok(());
                }
                machine.send_can(self.place, frame, mark)
            })
            .unwrap_or(Ok(()));
        if sent.is_err() {
            self.look();
        }
        sent
    }
}

impl Can for SimPort {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send_frame(frame, |_| 0)
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send_frame(frame, |machine| machine.begin_stamp(self.place))
    }

    fn stamp(&self) -> Option<Instant> {
        self.look();
        self.alive(|machine| machine.core(self.place).stamp)
            .flatten()
    }

    fn discard_unsent(&self) {
        self.alive(|machine| machine.discard_unsent(self.place));
    }

    #[inline]
    fn try_receive(&self) -> Option<Received> {
        let waits = self.shared.glance.can(self.place);
        if !waits.load(Ordering::Relaxed) {
            self.look();
            return None;
        }
        let received = self
            .alive(|machine| machine.receive_can(self.place))
            .flatten();
        if received.is_none() {
            self.look();
        }
        received
    }

    fn wake_on_receive(&self, on: bool) {
        self.alive(|machine| machine.wake_on_receive(self.place, on));
    }

    fn overruns(&self) -> u32 {
        self.alive(|machine| machine.core(self.place).overruns)
            .unwrap_or(0)
    }

    fn errors(&self) -> CanErrors {
        self.alive(|machine| {
            let now = machine.at();
            machine.network.errors(self.place, now)
        })
        .unwrap_or_default()
    }
}

impl Lines for SimPort {
    fn send(&self, line: Line, edge: Edge) {
        self.alive(|machine| {
            if !machine.holds(self.place, || Output::Edge(line, edge)) {
                machine.send_edge(self.place.system, line, edge);
            }
        });
    }

    #[inline]
    fn received(&self, line: Line, edge: Edge) -> u32 {
        self.look();
        let glance = &self.shared.glance;
        let count = glance.edges(self.place.system, line, edge);
        count.load(Ordering::Relaxed)
    }

    fn time_edge(&self) -> Option<TimeEdge> {
        self.look();
        self.shared.lock().system(self.place.system).time_edge
    }

    #[inline]
    fn peer_powered(&self) -> bool {
        self.look();
        let level = self.shared.glance.level(self.place.system.peer());
        level.load(Ordering::Relaxed)
    }
}

impl Link for SimLink {
    const MAX_WORDS: usize = DATAGRAM_MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        assert!(
            words.len() <= DATAGRAM_MAX_WORDS,
            "a datagram has at most {DATAGRAM_MAX_WORDS} words"
        );
        let system = self.0.place.system;
        let sent = self
            .0
            .alive(|machine| {
                if machine.holds(self.0.place, || Output::Datagram(words.to_vec())) {
                    return Ok(());
                }
                machine.send_link(system, words)
            })
            .unwrap_or(Ok(()));
        if sent.is_err() {
            self.0.look();
        }
        sent
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        let system = self.0.place.system;
        let waits = self.0.shared.glance.link(system);
        let datagram = waits.load(Ordering::Relaxed).then(|| {
            self.0
                .alive(|machine| machine.receive_link(system))
                .flatten()
        });
        let Some(datagram) = datagram.flatten() else {
            self.0.look();
            return None;
        };
        let len = datagram.len().min(words.len());
        words[..len].copy_from_slice(&datagram[..len]);
        Some(len)
    }
}

impl DataFlash for SimPort {
    const PAGE_BYTES: u32 = data_flash::PAGE_BYTES;
    const SECTOR_BYTES: u32 = data_flash::SECTOR_BYTES;
    const SECTORS: u32 = data_flash::SECTORS;

    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        self.shared
            .lock()
            .system(self.place.system)
            .flash
            .read(offset, into)
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        assert!(self.is_control(), "only core 0 programs the flash");
        self.alive(|machine| {
            let start = |flash: &mut Flash, now| flash.start_erase(sector, now);
            machine.start_flash(self.place.system, start)
        })
        .unwrap_or(Err(FlashError::Failed))
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        assert!(self.is_control(), "only core 0 programs the flash");
        self.alive(|machine| {
            let start = |flash: &mut Flash, now| flash.start_program(offset, data, now);
            machine.start_flash(self.place.system, start)
        })
        .unwrap_or(Err(FlashError::Failed))
    }

    fn status(&self) -> FlashStatus {
        self.look();
        let SimPort { shared, place, .. } = self;
        let may_be_busy = shared.glance.flash(place.system);
        if !may_be_busy.load(Ordering::Relaxed) {
            return FlashStatus::Idle;
        }
        if shared.lock().system(place.system).flash.is_busy() {
            return FlashStatus::Busy;
        }
        may_be_busy.store(false, Ordering::Relaxed);
        FlashStatus::Idle
    }
}

impl Supply for SimPort {
    const WINDOW_OPENS_US: u32 = Window::TARGET.opens_us;
    const WINDOW_CLOSES_US: u32 = Window::TARGET.closes_us;
    const FIRST_SERVICE_US: u32 = Window::TARGET.first_us;

    fn reset_cause(&self) -> ResetCause {
        let mut machine = self.shared.lock();
        machine.system(self.place.system).supply.cause()
    }

    fn starts(&self) -> u8 {
        let mut machine = self.shared.lock();
        machine.system(self.place.system).supply.starts()
    }

    fn confirm_start(&self) {
        self.alive(|machine| {
            let supply = &mut machine.system(self.place.system).supply;
            supply.act(|supply| supply.confirm_start());
        });
    }

    fn watchdog_question(&self) -> u8 {
        let mut machine = self.shared.lock();
        machine.system(self.place.system).supply.question()
    }

    fn service_watchdog(&self, answer: u8) {
        assert!(self.is_control(), "only core 0 serves the watchdog");
        self.alive(|machine| {
            if !machine.holds(self.place, || Output::Service(answer)) {
                machine.service_watchdog(self.place.system, answer);
            }
        });
    }

    fn request_reset(&self, request: ResetRequest) {
        self.alive(|machine| machine.request_reset(self.place, request));
    }

    fn show_role(&self, lamp: RoleLamp) {
        let system = self.place.system;
        self.alive(|machine| {
            if machine.system(system).lamp != lamp {
                machine.system(system).lamp = lamp;
                machine.log(system, SystemEventKind::Lamp(lamp));
            }
        });
    }
}
