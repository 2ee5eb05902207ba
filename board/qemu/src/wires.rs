//! What lies between the machines: the bus, the level lines, edges and the link, with their faults.

use tandem_board::{CanFrame, CoreAddress, Duration, Instant, SystemId};
use tandem_peripherals::wires::{BusFault, Cuts, Wire};

/// A frame of a core.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OnBus {
    pub(crate) from: CoreAddress,
    pub(crate) frame: CanFrame,
    /// When the core sent it.
    pub(crate) sent: Instant,
    /// When it is on the bus.
    pub(crate) at: Instant,
}

/// The connections of both systems.
#[derive(Debug, Default)]
pub(crate) struct Wires {
    pub(crate) cuts: Cuts,
    pub(crate) held_low: [bool; 2],
    pub(crate) bus: [BusFault; 2],
    /// The level lines as the other systems were told of them.
    told: [bool; 2],
    /// Frames behind a slow connection.
    late: Vec<OnBus>,
    /// How often something was left to chance.
    draws: u64,
}

impl Wires {
    /// The level of this system's line at the other one, if that has changed. `is_on`: its supply
    /// has power and is out of reset.
    pub(crate) fn level_changed(&mut self, of: SystemId, is_on: bool) -> Option<bool> {
        let is_high = self.cuts.level(of, is_on && !self.held_low[of.index()]);
        let told = std::mem::replace(&mut self.told[of.index()], is_high);
        (told != is_high).then_some(is_high)
    }

    /// A frame of a core, if it is on the bus now: it may be lost, or come later.
    pub(crate) fn send(&mut self, frame: OnBus) -> Option<OnBus> {
        let BusFault { lost_out, late, .. } = self.bus[frame.from.system.index()];
        if self.cuts.is_cut(Wire::Can, frame.from.system) || self.loses(lost_out) {
            return None;
        }
        let at = frame.at + late;
        if at == frame.at {
            return Some(frame);
        }
        self.late.push(OnBus { at, ..frame });
        None
    }

    /// The frames behind a slow connection that are on the bus by now. One that is no longer slow
    /// delivers at once.
    pub(crate) fn due(&mut self, now: Instant) -> Vec<OnBus> {
        let bus = self.bus;
        let is_due = |frame: &mut OnBus| {
            frame.at <= now || bus[frame.from.system.index()].late == Duration::ZERO
        };
        let due = self.late.extract_if(.., is_due);
        due.map(|frame| OnBus { at: now, ..frame }).collect()
    }

    /// Whether a frame on the bus reaches this system.
    pub(crate) fn hears(&mut self, system: SystemId) -> bool {
        !self.cuts.is_cut(Wire::Can, system) && !self.loses(self.bus[system.index()].lost_in)
    }

    /// Draws whether something with this probability happens. The same in each run.
    fn loses(&mut self, permille: u16) -> bool {
        if permille == 0 {
            return false;
        }
        self.draws += 1;
        // SplitMix64.
        let mut drawn = self.draws.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        drawn = (drawn ^ (drawn >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        drawn = (drawn ^ (drawn >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (drawn ^ (drawn >> 31)) % 1_000 < permille.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::{CanId, CoreId};

    fn frame(system: SystemId, ms: u64) -> OnBus {
        let sent = Instant::ORIGIN + Duration::from_ms(ms);
        OnBus {
            from: CoreAddress::new(system, CoreId::CONTROL),
            frame: CanFrame::new(CanId::Standard(1), true, &[]).unwrap(),
            sent,
            at: sent,
        }
    }

    /// Frames are lost in one direction and of one system, as often as asked.
    #[test]
    fn a_faulty_connection_loses_frames_of_its_own_system() {
        let mut wires = Wires::default();
        wires.bus[0].lost_out = 100;
        wires.bus[1].lost_in = 1_000;
        let [a, b] = SystemId::ALL;
        let arrived = (0..10_000).filter(|ms| wires.send(frame(a, *ms)).is_some());
        assert!((8_900..9_100).contains(&arrived.count()));
        assert!((0..100).all(|ms| wires.send(frame(b, ms)).is_some()));
        assert!((0..100).all(|_| wires.hears(a) && !wires.hears(b)));
        wires.cuts.set(Wire::Can, b, true);
        assert!(wires.send(frame(b, 0)).is_none());
        assert!(wires.send(frame(a, 0)).is_some() || wires.send(frame(a, 0)).is_some());
    }

    #[test]
    fn a_slow_connection_delivers_later_and_at_once_when_it_is_mended() {
        let mut wires = Wires::default();
        let [a, b] = SystemId::ALL;
        wires.bus[a.index()].late = Duration::from_ms(3);
        assert!(wires.send(frame(a, 5)).is_none());
        assert!(wires.send(frame(a, 6)).is_none());
        assert!(wires.send(frame(b, 6)).is_some());
        let at = |ms| Instant::ORIGIN + Duration::from_ms(ms);
        assert!(wires.due(at(7)).is_empty());
        let [due] = &wires.due(at(8))[..] else {
            panic!("one frame is due");
        };
        assert_eq!((due.sent, due.at), (at(5), at(8)));
        wires.bus[a.index()] = BusFault::default();
        assert_eq!(wires.due(at(8)).len(), 1);
    }

    #[test]
    fn a_level_line_is_told_when_it_changes() {
        let mut wires = Wires::default();
        let a = SystemId::A;
        assert_eq!(wires.level_changed(a, true), Some(true));
        assert_eq!(wires.level_changed(a, true), None);
        wires.held_low[a.index()] = true;
        assert_eq!(wires.level_changed(a, true), Some(false));
        wires.cuts.set(Wire::Level, a, true);
        assert_eq!(
            wires.level_changed(a, true),
            Some(true),
            "cut, it reads as high"
        );
        assert_eq!(wires.level_changed(a, false), None);
    }
}
