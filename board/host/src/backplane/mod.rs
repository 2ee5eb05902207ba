//! The backplane of a run: the wires between the systems, the bus, the supplies' registers, the
//! traces.
//!
//! It holds everything that the cores of both systems, their supplies and the vehicle share, except
//! the LMUs. Portable code accesses it only through the board's traits.

mod layout;

use core::fmt;
use core::sync::atomic::AtomicU32;
use core::sync::atomic::Ordering::SeqCst;

use tandem_board::{
    CanErrors, CoreId, Duration, Edge, Forgery, Generation, HardwareFault, HardwareFaults, Instant,
    Line, ResetCause, ResetRequest, RoleLamp, SystemId, TimeEdge,
};
use tandem_peripherals::network::{BusFault, Conditions, Cuts, Wire};
use tandem_peripherals::stamp::{CAPTURE_WORDS, Capture, TimeStamp};
use tandem_peripherals::supply::starts_after;

use crate::clock;
use crate::name::RunName;
use crate::segment::{Segment, SegmentError};
use crate::trace_ring::TraceRing;
use layout::{Core, Run, System, WORDS};
pub(crate) use layout::{Deed, RINGS, Ring, TRANSMIT_WORDS, Transmit, supply_trace_ring};

/// "TDM" and the version of the layout, so that processes of different builds reject each other.
const MAGIC: u32 = 0x5444_4D07;
const NAME: &str = "backplane";
/// The longest delay of a disturbed connection, equal to the limit of `Kind::Late`. A
/// corrupt word in the shared memory must not cause a longer delay, because delayed frames
/// accumulate in the vehicle's process.
const LATE_MOST: Duration = Duration::from_ms(1_000);

/// Why the backplane of a run could not be created or opened.
#[derive(Debug, thiserror::Error)]
pub enum BackplaneError {
    /// The shared memory could not be created or mapped.
    #[error(transparent)]
    Segment(#[from] SegmentError),
    /// Another build made this backplane.
    #[error("run {0} was started by another version of this program")]
    OtherVersion(RunName),
}

/// The mapped backplane. It stays mapped until the process ends.
#[derive(Clone, Copy)]
pub struct Backplane {
    words: &'static [AtomicU32],
}

impl fmt::Debug for Backplane {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Backplane")
    }
}

/// A word of the backplane with one writer and several readers: a level, a count, a request.
#[derive(Clone, Copy)]
struct Register(&'static AtomicU32);

/// All accesses are SeqCst and pair with each other: every process sees the changes of all
/// registers in one order. A process that sees a change also sees all earlier writes of its writer.
impl Register {
    fn get(self) -> u32 {
        self.0.load(SeqCst)
    }

    fn set(self, value: u32) {
        self.0.store(value, SeqCst);
    }

    /// Returns the previous value.
    fn replace(self, value: u32) -> u32 {
        self.0.swap(value, SeqCst)
    }

    /// Adds 1, wrapping around, and returns the previous value.
    fn count(self) -> u32 {
        self.0.fetch_add(1, SeqCst)
    }

    fn change_bits(self, bits: u32, on: bool) {
        if on {
            self.0.fetch_or(bits, SeqCst);
        } else {
            self.0.fetch_and(!bits, SeqCst);
        }
    }
}

impl Backplane {
    /// Creates the backplane of a run: both level lines high, ignition off.
    pub(crate) fn create(run: &RunName) -> Result<Self, BackplaneError> {
        let segment = Box::leak(Box::new(Segment::<WORDS>::create(run, NAME)?));
        let backplane = Self {
            words: segment.words(),
        };
        for system in SystemId::ALL {
            backplane.set_level(system, true);
        }
        backplane.run(Run::Magic).set(MAGIC);
        Ok(backplane)
    }

    /// Maps the backplane of a run.
    pub(crate) fn open(run: &RunName) -> Result<Self, BackplaneError> {
        let segment = Box::leak(Box::new(Segment::<WORDS>::open(run, NAME)?));
        let backplane = Self {
            words: segment.words(),
        };
        if backplane.run(Run::Magic).get() != MAGIC {
            return Err(BackplaneError::OtherVersion(run.clone()));
        }
        Ok(backplane)
    }

    fn run(self, register: Run) -> Register {
        Register(&self.words[layout::run(register)])
    }

    fn system(self, system: SystemId, register: System) -> Register {
        Register(&self.words[layout::system(system, register)])
    }

    fn core(self, system: SystemId, core: CoreId, register: Core) -> Register {
        Register(&self.words[layout::core(system, core, register)])
    }

    fn edge(self, from: SystemId, line: Line, edge: Edge) -> Register {
        Register(&self.words[layout::edge(from, line, edge)])
    }

    fn edge_baseline(self, by: SystemId, line: Line, edge: Edge) -> Register {
        Register(&self.words[layout::edge_baseline(by, line, edge)])
    }

    /// Returns `N` words that begin at this index.
    fn part<const N: usize>(self, at: usize) -> &'static [AtomicU32; N] {
        &self.words[at..].as_chunks().0[0]
    }

    /// Returns the capture unit for what `from` sends on the time line.
    fn capture(self, from: SystemId) -> Capture<'static> {
        Capture {
            count: self.edge(from, Line::Time, Edge::Rising).0,
            stamps: self.part::<CAPTURE_WORDS>(layout::capture(from)),
        }
    }

    /// Returns the trace ring of a core, by its index, or of a supply, by [`supply_trace_ring`].
    pub(crate) fn trace_ring(self, index: usize) -> TraceRing {
        TraceRing::new(self.ring(RINGS.trace[index]))
    }

    /// Returns the words of a ring.
    pub(crate) fn ring(self, place: Ring) -> &'static [AtomicU32] {
        &self.words[place.at..place.at + place.words]
    }
}

/// The run as a whole.
impl Backplane {
    /// Publishes the ids of the run's processes; they wait until this is done. Launcher only.
    pub(crate) fn assemble(self, supplies: [u32; 2], vehicle: u32) {
        for system in SystemId::ALL {
            self.set_supply(system, supplies[system.index()]);
        }
        self.run(Run::VehiclePid).set(vehicle);
        self.run(Run::Assembled).set(1);
    }

    pub(crate) fn is_assembled(self) -> bool {
        self.run(Run::Assembled).get() != 0
    }

    pub(crate) fn set_launcher(self, pid: u32) {
        self.run(Run::LauncherPid).set(pid);
    }

    /// Returns the id of the process that started the run; 0 if unknown.
    #[must_use]
    pub fn launcher_pid(self) -> u32 {
        self.run(Run::LauncherPid).get()
    }

    /// Returns the id of the vehicle's process; 0 before its start.
    #[must_use]
    pub fn vehicle_pid(self) -> u32 {
        self.run(Run::VehiclePid).get()
    }

    /// Returns the id of the process of a system's supply; 0 before its start.
    #[must_use]
    pub fn supply_pid(self, system: SystemId) -> u32 {
        self.system(system, System::SupplyPid).get()
    }

    pub(crate) fn set_ignition(self, on: bool) {
        self.run(Run::Ignition).set(u32::from(on));
    }

    /// Returns whether the vehicle's ignition is on.
    #[must_use]
    pub fn ignition(self) -> bool {
        self.run(Run::Ignition).get() != 0
    }

    /// Asks the vehicle to end the run.
    pub fn request_stop(self) {
        self.run(Run::Stop).set(1);
    }

    /// Returns whether an end of the run was requested.
    #[must_use]
    pub fn stop_requested(self) -> bool {
        self.run(Run::Stop).get() != 0
    }

    /// Cuts or restores a connection that starts at this system, with immediate effect.
    pub fn set_cut(self, wire: Wire, from: SystemId, is_cut: bool) {
        self.run(Run::Cuts)
            .change_bits(Cuts::bit(wire, from), is_cut);
    }

    /// Begins or ends a forgery by a foreign node of the bus.
    pub fn forge(self, forgery: Option<Forgery>) {
        // Never a half of one forgery with the id of another.
        self.run(Run::ForgedId).set(0);
        if let Some(Forgery { id, field, value }) = forgery {
            let bits = value.to_bits();
            self.run(Run::ForgedField).set(field.into());
            self.run(Run::ForgedHigh).set((bits >> 32) as u32);
            self.run(Run::ForgedLow).set(bits as u32);
            self.run(Run::ForgedId).set(u32::from(id) + 1);
        }
    }

    /// Returns what a foreign node forges.
    pub(crate) fn forgery(self) -> Option<Forgery> {
        let id = self.run(Run::ForgedId).get().checked_sub(1)?;
        let of = |register| self.run(register).get();
        let bits = u64::from(of(Run::ForgedHigh)) << 32 | u64::from(of(Run::ForgedLow));
        Some(Forgery {
            id: id as u16,
            field: of(Run::ForgedField) as u8,
            value: f64::from_bits(bits),
        })
    }

    /// Makes this system's level line read low at the other system, even while this system is on.
    pub(crate) fn hold_low(self, system: SystemId, held: bool) {
        self.system(system, System::HeldLow).set(u32::from(held));
    }

    /// Returns the level of `system`'s line as the other system reads it.
    pub(crate) fn level_at_peer(self, system: SystemId) -> bool {
        self.conditions().level(system, self.level(system))
    }

    /// Returns all cuts and disturbances.
    pub(crate) fn conditions(self) -> Conditions {
        Conditions {
            cuts: self.cuts(),
            held_low: SystemId::ALL.map(|of| self.system(of, System::HeldLow).get() != 0),
            bus: SystemId::ALL.map(|of| self.bus_fault(of)),
            hardware: SystemId::ALL.map(|of| self.faults(of)),
        }
    }

    /// Sets the faults of a system's connection to the CAN bus, with immediate effect.
    pub fn disturb_bus(self, system: SystemId, fault: BusFault) {
        self.system(system, System::LostOut)
            .set(fault.lost_out.into());
        self.system(system, System::LostIn)
            .set(fault.lost_in.into());
        for (register, id) in [System::DeafTo0, System::DeafTo1]
            .into_iter()
            .zip(fault.deaf_to)
        {
            let id = id.map_or(0, |id| u32::from(id) + 1);
            self.system(system, register).set(id);
        }
        self.system(system, System::LateMs)
            .set((fault.late.as_us() / 1_000) as u32);
    }

    fn bus_fault(self, system: SystemId) -> BusFault {
        let of = |register| self.system(system, register).get();
        BusFault {
            lost_out: of(System::LostOut) as u16,
            lost_in: of(System::LostIn) as u16,
            late: Duration::from_ms(of(System::LateMs).into()).min(LATE_MOST),
            deaf_to: [System::DeafTo0, System::DeafTo1]
                .map(|register| of(register).checked_sub(1).map(|id| id as u16)),
        }
    }

    /// Returns which connections are cut.
    #[must_use]
    pub fn cuts(self) -> Cuts {
        Cuts(self.run(Run::Cuts).get())
    }
}

/// Supplies.
impl Backplane {
    /// Counts a power-on of the system and returns its number, from 1.
    pub(crate) fn power_on(self, system: SystemId) -> u32 {
        self.system(system, System::PowerOns).count() + 1
    }

    /// Sets the delay between the ignition and the power-on of the system. Only the launcher calls
    /// this, before the start.
    pub(crate) fn set_stagger(self, system: SystemId, stagger: Duration) {
        let us = u32::try_from(stagger.as_us()).unwrap_or(u32::MAX);
        self.system(system, System::StaggerUs).set(us);
    }

    pub(crate) fn stagger(self, system: SystemId) -> Duration {
        Duration::from_us(u64::from(self.system(system, System::StaggerUs).get()))
    }

    /// Asks the launcher to start a new supply for a system whose supply has died.
    pub(crate) fn request_power(self, system: SystemId) {
        self.system(system, System::PowerRequest).set(1);
    }

    /// Returns whether a request for power is pending, and clears it. Launcher only.
    pub(crate) fn take_power_request(self, system: SystemId) -> bool {
        self.system(system, System::PowerRequest).replace(0) != 0
    }

    /// Records the supply that the launcher has started for the system.
    pub(crate) fn set_supply(self, system: SystemId, pid: u32) {
        self.system(system, System::SupplyPid).set(pid);
    }

    pub(crate) fn set_level(self, system: SystemId, high: bool) {
        self.system(system, System::LevelLow).set(u32::from(!high));
    }

    /// Returns the level line of the system's supply; low (`false`) in reset and without power.
    #[must_use]
    pub fn level(self, system: SystemId) -> bool {
        self.system(system, System::LevelLow).get() == 0
    }

    /// Injects or repairs a hardware fault of a system.
    pub fn set_fault(self, of: SystemId, fault: HardwareFault, present: bool) {
        self.system(of, System::Faults)
            .change_bits(HardwareFaults::bit(fault), present);
    }

    /// Notes what is done to a system, for the recording.
    pub(crate) fn note(self, of: SystemId, deed: Deed) {
        self.system(of, System::Deeds)
            .change_bits(1 << deed as u32, true);
    }

    /// Returns what was noted since the last call. Vehicle only.
    pub(crate) fn take_noted(self, of: SystemId) -> impl Iterator<Item = Deed> {
        let register = self.system(of, System::Deeds);
        let noted = match register.get() {
            0 => 0,
            _ => register.replace(0),
        };
        let deeds = Deed::ALL.into_iter();
        deeds.filter(move |deed| noted >> *deed as u32 & 1 == 1)
    }

    /// Returns the hardware faults of a system.
    #[must_use]
    pub fn faults(self, of: SystemId) -> HardwareFaults {
        HardwareFaults(self.system(of, System::Faults).get())
    }

    pub(crate) fn set_reset_cause(self, system: SystemId, cause: ResetCause) {
        self.system(system, System::ResetCause).set(cause.code());
        let starts = self.system(system, System::Starts);
        starts.set(starts_after(starts.get() as u8, cause).into());
    }

    /// Returns the starts of the system since power-on, or since one of them was confirmed.
    pub(crate) fn starts(self, system: SystemId) -> u8 {
        self.system(system, System::Starts).get() as u8
    }

    /// Notes that the system's incarnation works.
    pub fn confirm_start(self, system: SystemId) {
        self.system(system, System::Starts).set(0);
    }

    /// Returns why the system's current incarnation began.
    #[must_use]
    pub fn reset_cause(self, system: SystemId) -> ResetCause {
        let code = self.system(system, System::ResetCause).get();
        // An invalid code means that a register was overwritten: assume the worst.
        ResetCause::from_code(code).unwrap_or(ResetCause::Trap)
    }

    pub(crate) fn request_reset(self, system: SystemId, request: ResetRequest) {
        self.system(system, System::ResetRequest)
            .set(1 + request.code());
    }

    /// Returns the pending reset request, and clears it. Supply only.
    pub(crate) fn take_reset_request(self, system: SystemId) -> Option<ResetRequest> {
        let register = self.system(system, System::ResetRequest).replace(0);
        let code = register.checked_sub(1)?;
        // An invalid code means that a register was overwritten: assume the worst.
        Some(ResetRequest::from_code(code).unwrap_or(ResetRequest::Suspend))
    }

    pub(crate) fn set_booted(self, system: SystemId, slot: u32) {
        self.system(system, System::Booted).set(slot);
    }

    /// Returns the slot to which core 0 jumped last.
    pub(crate) fn booted(self, system: SystemId) -> u32 {
        self.system(system, System::Booted).get()
    }

    /// Asks the supply to start a core. Core 0 only.
    pub(crate) fn release_core(self, system: SystemId, core: CoreId) {
        self.system(system, System::Released)
            .change_bits(1 << core.index(), true);
    }

    /// Returns the cores that core 0 has released since the last call. Supply only.
    pub(crate) fn take_released(self, system: SystemId) -> impl Iterator<Item = CoreId> {
        let released = self.system(system, System::Released).replace(0);
        CoreId::ALL
            .into_iter()
            .filter(move |core| released >> core.index() & 1 == 1)
    }

    pub(crate) fn show_role(self, system: SystemId, lamp: RoleLamp) {
        self.system(system, System::Lamp).set(lamp.code());
    }

    /// Returns the role that the system shows. A system without power shows [`RoleLamp::Starting`].
    #[must_use]
    pub fn role(self, system: SystemId) -> RoleLamp {
        let code = self.system(system, System::Lamp).get();
        RoleLamp::from_code(code).unwrap_or(RoleLamp::Starting)
    }
}

/// Cores.
impl Backplane {
    pub(crate) fn set_core_pid(self, system: SystemId, core: CoreId, pid: u32) {
        self.core(system, core, Core::Pid).set(pid);
    }

    /// Returns the id of the process of a core; 0 while it has none.
    #[must_use]
    pub fn core_pid(self, system: SystemId, core: CoreId) -> u32 {
        self.core(system, core, Core::Pid).get()
    }

    pub(crate) fn set_generation(self, system: SystemId, core: CoreId, incarnation: Generation) {
        self.core(system, core, Core::Generation).set(incarnation.0);
    }

    /// Returns the latest incarnation of the core that the supply has started; 0 before the first.
    #[must_use]
    pub fn generation(self, system: SystemId, core: CoreId) -> Generation {
        Generation(self.core(system, core, Core::Generation).get())
    }

    pub(crate) fn set_wakes_on_receive(self, system: SystemId, core: CoreId, on: bool) {
        self.core(system, core, Core::WakeOnReceive)
            .set(u32::from(on));
    }

    pub(crate) fn wakes_on_receive(self, system: SystemId, core: CoreId) -> bool {
        self.core(system, core, Core::WakeOnReceive).get() != 0
    }

    /// Returns how many times the core has discarded the frames in its transmit ring; wraps around.
    pub(crate) fn discards(self, system: SystemId, core: CoreId) -> u32 {
        self.core(system, core, Core::Discards).get()
    }

    /// Counts one discard: the bus drops frames that carry an older count. The ring ensures that
    /// the bus sees the new count before it sees a frame that carries it.
    pub(crate) fn count_discard(self, system: SystemId, core: CoreId) {
        self.core(system, core, Core::Discards).count();
    }

    /// Sets the error counters of a core's CAN controller, which is part of the bus. Vehicle only.
    pub(crate) fn set_can_errors(self, system: SystemId, core: CoreId, errors: CanErrors) {
        self.core(system, core, Core::CanErrors)
            .set(errors.to_word());
    }

    /// Returns the error counters of a core's CAN controller.
    #[must_use]
    pub fn can_errors(self, system: SystemId, core: CoreId) -> CanErrors {
        CanErrors::from_word(self.core(system, core, Core::CanErrors).get())
    }

    /// Returns when the newest frame that the core wanted stamped was on the bus.
    pub(crate) fn can_stamp(self, system: SystemId, core: CoreId) -> Option<Instant> {
        let mark = self.core(system, core, Core::Marks).get();
        self.stamp(system, core).read(mark)
    }

    /// Begins the record of the core's next stamped frame, and returns the frame's mark. The marks
    /// go on over the core's incarnations: no frame of an earlier one can be the newest.
    pub(crate) fn begin_stamp(self, system: SystemId, core: CoreId) -> u32 {
        let mark = self.core(system, core, Core::Marks).count().wrapping_add(1);
        self.stamp(system, core).forget(mark);
        mark
    }

    /// Records when a frame of the core with this mark was on the bus. Vehicle only.
    pub(crate) fn set_can_stamp(self, system: SystemId, core: CoreId, mark: u32, at: Instant) {
        self.stamp(system, core).write(mark, at);
    }

    fn stamp(self, system: SystemId, core: CoreId) -> TimeStamp<'static> {
        TimeStamp(self.part(layout::core(system, core, Core::CanStamp)))
    }

    /// Counts one lost trace record of the core.
    pub(crate) fn count_lost_trace(self, system: SystemId, core: CoreId) {
        self.core(system, core, Core::TraceLost).count();
    }

    /// Returns how many trace records of the core were lost because of a full ring; wraps around.
    pub(crate) fn lost_trace(self, system: SystemId, core: CoreId) -> u32 {
        self.core(system, core, Core::TraceLost).get()
    }
}

/// Lines.
impl Backplane {
    /// Sends an edge; returns whether it arrives. The sender's process acts as the capture unit of
    /// the receiver, so a stamp has no latency of an interrupt: all processes have one clock.
    pub(crate) fn send_edge(self, from: SystemId, line: Line, edge: Edge) -> bool {
        if self.cuts().is_cut(Wire::Line(line), from) {
            return false;
        }
        match (line, edge) {
            (Line::Time, Edge::Rising) => self.capture(from).edge(clock::now),
            _ => _ = self.edge(from, line, edge).count(),
        }
        true
    }

    /// Returns the newest rising edge that `by` has received on the time line since its power-on.
    pub(crate) fn time_edge(self, by: SystemId) -> Option<TimeEdge> {
        let before = self.edge_baseline(by, Line::Time, Edge::Rising).get();
        self.capture(by.peer()).newest(before)
    }

    /// Returns the number of edges that `from` has sent since the run began; wraps around.
    pub(crate) fn edges(self, from: SystemId, line: Line, edge: Edge) -> u32 {
        self.edge(from, line, edge).get()
    }

    /// Returns the number of edges that `by` has received since its power-on.
    pub(crate) fn received_edges(self, by: SystemId, line: Line, edge: Edge) -> u32 {
        let before = self.edge_baseline(by, line, edge).get();
        self.edges(by.peer(), line, edge).wrapping_sub(before)
    }

    /// Resets the counts of edges that system `by` has received. Called at its power-on.
    pub(crate) fn clear_received_edges(self, by: SystemId) {
        for line in Line::ALL {
            for edge in [Edge::Rising, Edge::Falling] {
                let now = self.edges(by.peer(), line, edge);
                self.edge_baseline(by, line, edge).set(now);
            }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
