//! The supply of a system: power, watchdogs, reset generator, reset cause. T-CHIP-6
//!
//! One process for each system. It powers the system's three cores, which die with it. It monitors
//! core 0 and resets the system when core 0 dies, misses the watchdog, or requests a reset. It also
//! monitors the other supply, and notifies its own system at once when that supply loses power. It
//! depends on the vehicle (which is the battery: without it there is no power), but not on the
//! launcher.
//!
//! `tandem_peripherals::supply` decides; this module runs that model in a process. The level
//! line is high before the ignition is on. When the ignition goes off or the vehicle ends, the
//! supply kills its cores and ends.

use std::ffi::c_int;
use std::io::{self, Read as _};
use std::os::fd::{AsFd as _, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::os::unix::process::ExitStatusExt as _;
use std::process::{Child, Command};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use rustix::process::Signal;
use signal_hook::consts::SIGURG;
use signal_hook::low_level::pipe;
use tandem_board::{
    CoreId, Duration, Generation, Instant, ResetCause, RoleLamp, SupplyEvent, SystemId,
};
use tandem_peripherals::codec::{DATAGRAM_WORDS, SERVICE_WORDS, decode_service};
use tandem_peripherals::supply::{Change, Config, Supply as Model};
use tandem_shm::{FitError, bare, fifo};

use crate::args::{CoreArgs, SupplyArgs};
use crate::backplane::{Backplane, BackplaneError, RINGS, Ring, supply_trace_ring};
use crate::clock;
use crate::doorbell::Ringers;
use crate::flash_file::{FlashFileError, HostFlash};
use crate::memory;
use crate::segment::SegmentError;
use crate::spawn::{self, Watched};

/// How often the supply reads its registers while its system starts.
const PERIOD: Duration = Duration::from_ms(1);
/// The period after all cores have started. A process's death, the end of the watchdog's window and
/// [`POKE`] wake the supply at once. Keep it short: only a late tick shows a stall ([`HELD_UP`]).
const CALM_PERIOD: Duration = Duration::from_ms(20);
/// The signal that makes a supply or the launcher read its registers. It has no effect before its
/// handler is installed.
const POKE: Signal = Signal::URG;

/// Makes the supply of a system read its registers now. No effect if there is no supply.
pub(crate) fn poke(backplane: Backplane, system: SystemId) {
    spawn::signal(backplane.supply_pid(system), POKE);
}

/// Makes the launcher read its registers now.
pub(crate) fn poke_launcher(backplane: Backplane) {
    spawn::signal(backplane.launcher_pid(), POKE);
}

/// Pokes and other signals as a stream, so that a signal that arrives just before a sleep also
/// ends that sleep.
#[derive(Debug)]
pub(crate) struct Pokes(UnixStream);

impl Pokes {
    /// Starts to receive pokes and these signals.
    pub(crate) fn receive(signals: &[c_int]) -> io::Result<Self> {
        let (read, write) = UnixStream::pair()?;
        read.set_nonblocking(true)?;
        for signal in signals {
            pipe::register(*signal, write.try_clone()?)?;
        }
        pipe::register(SIGURG, write)?;
        Ok(Self(read))
    }

    /// Returns a descriptor that is readable after a poke.
    pub(crate) fn fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }

    /// Discards all pokes that were received so far.
    pub(crate) fn take(&mut self) {
        let mut pokes = [0; 16];
        while (&self.0).read(&mut pokes).is_ok_and(|count| count > 0) {}
    }
}

/// If a poll is later than this, the supply itself was delayed: its process or machine was stopped.
const HELD_UP: Duration = Duration::from_ms(50);
/// Why a supply cannot work.
#[derive(Debug, thiserror::Error)]
pub enum SupplyError {
    /// The backplane cannot be mapped.
    #[error(transparent)]
    Backplane(#[from] BackplaneError),
    /// The LMU cannot be mapped.
    #[error("LMU: {0}")]
    Lmu(#[from] SegmentError),
    /// The data flash cannot be used.
    #[error(transparent)]
    Flash(#[from] FlashFileError),
    /// The operating system refused a signal handler.
    #[error("a signal cannot be handled: {0}")]
    Signal(io::Error),
    /// The backplane has a different layout from that of this build.
    #[error("the rings of the backplane do not fit: {0:?}")]
    Fit(FitError),
}

impl From<FitError> for SupplyError {
    fn from(error: FitError) -> Self {
        Self::Fit(error)
    }
}

/// Runs as the supply of a system until the ignition is off. `command` makes the command that
/// starts a core.
///
/// Call it on the main thread, because cores die with the thread that started them. Claims
/// real-time scheduling as `args` specifies.
///
/// # Errors
/// [`SupplyError`] if the run has ended, or the LMU or the data flash cannot be used. A core that
/// cannot be started is not an error: it counts as dead.
pub fn run(args: &SupplyArgs, command: &dyn Fn(&CoreArgs) -> Command) -> Result<(), SupplyError> {
    let _ = args.claim();
    let pokes = Pokes::receive(&[]).map_err(SupplyError::Signal)?;
    let backplane = Backplane::open(&args.common.run)?;
    HostFlash::prepare(&args.flash)?;
    let power_on = backplane.power_on(args.system);
    let lmu = memory::open_lmu(&args.common.run, args.system)?;
    backplane
        .trace_ring(supply_trace_ring(args.system))
        .begin_incarnation();
    let Some((vehicle, peer)) = wait_for_ignition(args, backplane, power_on) else {
        return Ok(());
    };
    let services = RINGS.service[args.system.index()];
    let link = RINGS.link[args.system.peer().index()];
    let mut supply = Supply {
        args,
        command,
        backplane,
        lmu,
        ringers: Ringers::new(&args.common.run),
        services: bare::fifo_consumer(backplane.ring(services), services.shape)?,
        link,
        cores: [None, None, None],
        begun: [false; CoreId::COUNT],
        model: Model::new(Config::DESKTOP),
        peer,
        peer_pid: backplane.supply_pid(args.system.peer()),
        pokes,
    };
    if power_on > 1 {
        // Not at the first power-on: there are no old edges, and the other system may already be on
        // and have sent edges that must count.
        backplane.clear_received_edges(args.system);
    }
    supply.work(&vehicle);
    Ok(())
}

/// Waits until all processes of the run are known and the ignition is on; `None` if that can no
/// longer happen.
fn wait_for_ignition(
    args: &SupplyArgs,
    backplane: Backplane,
    power_on: u32,
) -> Option<(Watched, Option<Watched>)> {
    if !spawn::wait_until_assembled(backplane) {
        return None;
    }
    let vehicle = Watched::new(backplane.vehicle_pid())?;
    while !backplane.ignition() {
        if vehicle.has_ended() || backplane.stop_requested() {
            return None;
        }
        clock::sleep_until(clock::now() + PERIOD);
    }
    let stagger = backplane.stagger(args.system);
    if stagger > Duration::ZERO && power_on == 1 {
        backplane.set_level(args.system, false);
        clock::sleep_until(clock::now() + stagger);
    }
    let peer = Watched::new(backplane.supply_pid(args.system.peer()));
    if peer.is_none() {
        backplane.set_level(args.system.peer(), false);
    }
    Some((vehicle, peer))
}

struct Supply<'a> {
    args: &'a SupplyArgs,
    command: &'a dyn Fn(&CoreArgs) -> Command,
    backplane: Backplane,
    lmu: &'static [AtomicU32],
    ringers: Ringers,
    services: fifo::Consumer<'static, [u32; SERVICE_WORDS]>,
    link: Ring,
    cores: [Option<PoweredCore>; CoreId::COUNT],
    /// Whether each core has started in this incarnation of the system.
    begun: [bool; CoreId::COUNT],
    model: Model,
    /// The other supply and its process id; `None` if that supply has died.
    peer: Option<Watched>,
    peer_pid: u32,
    pokes: Pokes,
}

struct PoweredCore {
    child: Child,
    watched: Option<Watched>,
}

impl Supply<'_> {
    fn work(&mut self, vehicle: &Watched) {
        let now = clock::now();
        let change = self.model.power_on(now);
        self.carry_out(change);
        let mut next = now + PERIOD;
        loop {
            let has_news = self.sleep(vehicle, next);
            let now = clock::now();
            if now.since(next) > HELD_UP {
                self.model.was_blind(next, now);
            }
            if !self.backplane.ignition() || has_news && vehicle.has_ended() {
                self.kill_cores();
                self.reap_all();
                return;
            }
            if has_news {
                // Clear the pokes before reading the registers: a later poke ends the next sleep.
                self.pokes.take();
                self.look_at_peer();
                self.look_at_cores(now);
            }
            self.follow_peer();
            self.look_at_registers();
            let pins = self.backplane.faults(self.args.system);
            let change = self.model.observe(now, pins);
            self.carry_out(change);
            let cores_stand = self.cores.iter().all(Option::is_none);
            let change = self.model.poll(now, cores_stand);
            self.carry_out(change);
            // Missed ticks are skipped.
            next = self.next_tick(now);
        }
    }

    /// Returns the time at which the registers must be read next.
    fn next_tick(&self, now: Instant) -> Instant {
        let is_calm = self.model.is_on() && self.begun == [true; CoreId::COUNT];
        let period = if is_calm { CALM_PERIOD } else { PERIOD };
        (now + period).min(self.model.next().max(now + PERIOD))
    }

    /// Sleeps until a process ends, a poke arrives or the next tick is due. Returns `false` if the
    /// tick was due, or if the signal of a poke interrupted the sleep. That poke, or a process that
    /// ends as the sleep ends, stays readable and ends the next sleep at once.
    fn sleep(&self, vehicle: &Watched, next: Instant) -> bool {
        let is_watched = |core: &PoweredCore| core.watched.is_some();
        let all_watched = self.cores.iter().flatten().all(is_watched);
        let cores = self
            .cores
            .iter()
            .flatten()
            .filter_map(|core| core.watched.as_ref());
        let fds = cores.chain(&self.peer).map(Watched::fd);
        let fds = fds.chain([vehicle.fd(), self.pokes.fd()]);
        // A failure needs no handling: everything is looked at.
        let has_news = clock::wait_for(fds, next.since(clock::now()));
        has_news.unwrap_or(true) || !all_watched
    }

    fn look_at_peer(&mut self) {
        let system = self.args.system.peer();
        if self.peer.as_ref().is_some_and(Watched::has_ended) {
            self.peer = None;
            // If a new supply has already replaced it, that supply sets the level itself.
            if self.backplane.supply_pid(system) == self.peer_pid {
                self.set_level(system, false);
            }
        }
    }

    /// Watches a supply that has replaced the other one.
    fn follow_peer(&mut self) {
        let pid = self.backplane.supply_pid(self.args.system.peer());
        if self.peer.is_none() && pid != self.peer_pid {
            (self.peer_pid, self.peer) = (pid, Watched::new(pid));
        }
    }

    fn look_at_cores(&mut self, now: Instant) {
        let on = self.model.is_on();
        for core in CoreId::ALL {
            let place = &mut self.cores[core.index()];
            let Some(powered) = place else { continue };
            let ended = powered.child.try_wait();
            if !matches!(ended, Ok(None)) {
                *place = None;
                self.backplane.set_core_pid(self.args.system, core, 0);
                if on {
                    let status = ended.ok().flatten();
                    let signal = status.and_then(|status| status.signal()).unwrap_or(0);
                    let signal = u8::try_from(signal).unwrap_or(0);
                    self.trace(SupplyEvent::CoreDied { core, signal });
                }
                // Core 0 supervises cores 1 and 2: it notices their deaths and requests a reset.
                if core == CoreId::CONTROL && on {
                    let change = self.model.reset(now, ResetCause::Trap);
                    self.carry_out(change);
                }
            }
        }
    }

    fn look_at_registers(&mut self) {
        if let Some(request) = self.backplane.take_reset_request(self.args.system) {
            self.model.request(request);
        }
        if self.model.is_on() {
            for core in self.backplane.take_released(self.args.system) {
                self.start(core);
            }
        }
        while self.model.is_on()
            && let Ok(Some(words)) = self.services.receive()
        {
            let (at, answer) = decode_service(words);
            // Read the clock again: `now` may be older than these services.
            let change = self.model.service(clock::now(), at, answer);
            self.carry_out(change);
        }
    }

    fn carry_out(&mut self, change: Option<Change>) {
        match change {
            None => {}
            Some(Change::Start(cause)) => self.start_system(cause),
            Some(Change::Reset(cause)) => self.stop_all(cause, RoleLamp::Starting),
            Some(Change::Suspend) => {
                self.stop_all(ResetCause::Software, RoleLamp::Suspended);
                self.trace(SupplyEvent::Suspended);
            }
            // Only the cores are killed here: this process ends at the end of the run.
            Some(Change::PowerOff) => self.kill_cores(),
        }
    }

    fn stop_all(&mut self, cause: ResetCause, lamp: RoleLamp) {
        self.set_level(self.args.system, false);
        self.kill_cores();
        self.trace(SupplyEvent::Reset(cause));
        self.backplane.show_role(self.args.system, lamp);
    }

    fn start_system(&mut self, cause: ResetCause) {
        self.clear_memory();
        self.backplane.set_reset_cause(self.args.system, cause);
        // Discard requests of the previous incarnation.
        self.backplane.take_reset_request(self.args.system);
        self.backplane
            .take_released(self.args.system)
            .for_each(drop);
        self.begun = [false; CoreId::COUNT];
        for core in CoreId::ALL {
            let generation = self.backplane.generation(self.args.system, core).0 + 1;
            self.backplane
                .set_generation(self.args.system, core, Generation(generation));
        }
        self.set_level(self.args.system, true);
        // Start only core 0, which releases the other cores. T-BOOT-2
        self.start(CoreId::CONTROL);
    }

    /// Clears the shared memory as at power-on. All cores must be dead.
    fn clear_memory(&mut self) {
        for word in self.lmu {
            word.store(0, Relaxed);
        }
        while let Ok(Some(_)) = self.services.receive() {}
        // Discard datagrams in transit to the cores. The ring was checked when the supply started.
        if let Ok(mut link) = bare::fifo_consumer::<[u32; DATAGRAM_WORDS]>(
            self.backplane.ring(self.link),
            self.link.shape,
        ) {
            while let Ok(Some(_)) = link.receive() {}
        }
    }

    fn start(&mut self, core: CoreId) {
        if core::mem::replace(&mut self.begun[core.index()], true) {
            return;
        }
        let system = self.args.system;
        let generation = self.backplane.generation(system, core);
        let mut command = (self.command)(&self.args.core(core, generation));
        // A core that cannot be started counts as a core that died at its start. If it is core 0,
        // the system is reset, because the watchdog is not serviced.
        if let Ok(child) = spawn::spawn_bound(&mut command) {
            self.trace(SupplyEvent::CoreStarted { core, generation });
            self.backplane.set_core_pid(system, core, child.id());
            let watched = Watched::new(child.id());
            self.cores[core.index()] = Some(PoweredCore { child, watched });
        }
    }

    /// Writes to the supply's trace. A full trace loses the record; driving never reads the trace.
    fn trace(&self, event: SupplyEvent) {
        let trace_ring = self
            .backplane
            .trace_ring(supply_trace_ring(self.args.system));
        let _ = trace_ring.write(clock::now(), event.encode());
    }

    fn kill_cores(&mut self) {
        for core in self.cores.iter_mut().flatten() {
            // Fails if the process has already ended.
            let _ = core.child.kill();
        }
    }

    fn reap_all(&mut self) {
        for core in CoreId::ALL {
            if let Some(mut powered) = self.cores[core.index()].take() {
                let _ = powered.child.wait();
                self.backplane.set_core_pid(self.args.system, core, 0);
            }
        }
    }

    /// Changes a level line, and interrupts core 0 of the system at its other end.
    fn set_level(&self, of: SystemId, high: bool) {
        self.backplane.set_level(of, high);
        self.ringers.ring(of.peer(), CoreId::CONTROL);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RunName;
    use crate::args::{Common, Schedule};
    use crate::backplane::tests::ScratchRun;
    use tandem_board::watchdog_answer;
    use tandem_peripherals::codec::encode_service;
    use tandem_peripherals::watchdog::question;

    fn args(run: &RunName) -> SupplyArgs {
        SupplyArgs {
            common: Common {
                run: run.clone(),
                schedule: Schedule::default(),
                network: None,
                extra: vec![],
            },
            system: SystemId::A,
            flash: std::path::PathBuf::new(),
        }
    }

    /// T-CHIP-6: services that the supply reads together are judged by their times of sending.
    #[test]
    fn services_that_are_seen_together_are_not_early() {
        let (run, backplane) = ScratchRun::create();
        let args = args(&run);
        let ring = RINGS.service[args.system.index()];
        let words = backplane.ring(ring);
        let mut core = bare::fifo_producer(words, ring.shape).unwrap();
        let mut supply = Supply {
            args: &args,
            command: &|_| Command::new("false"),
            backplane,
            lmu: &[],
            ringers: Ringers::new(&run),
            services: bare::fifo_consumer(words, ring.shape).unwrap(),
            link: RINGS.link[args.system.peer().index()],
            cores: [None, None, None],
            begun: [false; CoreId::COUNT],
            model: Model::new(Config::DESKTOP),
            peer: None,
            peer_pid: 0,
            pokes: Pokes::receive(&[]).unwrap(),
        };
        // This test does not start the cores.
        assert!(supply.model.power_on(clock::now()).is_some());
        let mut at = clock::now();
        for count in 0..3 {
            let answer = watchdog_answer(question(count));
            core.send(&encode_service(at, answer)).unwrap();
            at += Duration::from_ms(7);
        }
        clock::sleep_until(at);
        supply.look_at_registers();
        assert!(supply.model.is_on());
        assert_eq!(supply.model.question(), question(3), "all were accepted");
    }

    /// T-CHIP-6: if the launcher sets up the run and dies before a slow supply has started, that
    /// supply still starts its system.
    #[test]
    fn a_launcher_that_died_after_the_start_is_not_missed() {
        let (run, backplane) = ScratchRun::create();
        let mut launcher = Command::new("true").spawn().unwrap();
        backplane.set_launcher(launcher.id());
        let args = args(&run);
        launcher.wait().unwrap();
        assert!(
            wait_for_ignition(&args, backplane, 1).is_none(),
            "not assembled"
        );

        let own = std::process::id();
        backplane.assemble([own; 2], own);
        backplane.set_ignition(true);
        assert!(wait_for_ignition(&args, backplane, 1).is_some());
    }

    /// T-CHIP-6: a request that is made between two sleeps ends the next sleep at once.
    #[test]
    fn a_poke_that_arrives_before_the_sleep_ends_it() {
        let mut pokes = Pokes::receive(&[]).unwrap();
        spawn::signal(std::process::id(), POKE);
        let is_poked = |pokes: &Pokes, left| clock::wait_for([pokes.fd()], left).unwrap();
        assert!(is_poked(&pokes, Duration::from_ms(60_000)));
        pokes.take();
        assert!(!is_poked(&pokes, Duration::ZERO));
    }
}
