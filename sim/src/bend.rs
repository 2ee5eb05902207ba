//! Wrong values in a simulated machine: what each core hears and sends, and what core 2 publishes.

use std::cell::RefCell;
use std::rc::Rc;
use std::sync::atomic::Ordering::Relaxed;
use tandem_board::{Board as _, CanFrame, CanId, CoreId, Instant, LmuWord, SystemId};
use tandem_board_sim::{Poller, SimBoard, SimPair};
use tandem_cores::driving::types::{Trajectory, TrajectoryPoint};
use tandem_cores::layout::{ControllerMap, TRAJECTORY};
use tandem_cores::words::Payload as _;
use tandem_faults::{Bend, How, Kind, Signal, WrongValue};

/// What bends the trajectories of each system.
pub(crate) type Trajectories = Rc<RefCell<[Option<Bend>; 2]>>;

/// The faults of values that are present.
#[derive(Default)]
pub(crate) struct Bends {
    present: Vec<(Kind, SystemId)>,
    pub(crate) trajectories: Trajectories,
}

impl Bends {
    /// Begins or ends a fault. Returns `false` if it is none of values.
    pub(crate) fn follow(
        &mut self,
        pair: &mut SimPair,
        kind: Kind,
        of: SystemId,
        on: bool,
    ) -> bool {
        let core = match kind {
            Kind::WrongValue(wrong) if wrong.signal == Signal::Trajectory => {
                let bend = on.then(|| Bend::new(wrong));
                self.trajectories.borrow_mut()[of.index()] = bend;
                return true;
            }
            Kind::WrongValue(wrong) => wrong.core,
            _ => return false,
        };
        self.present.retain(|present| *present != (kind, of));
        if on {
            self.present.push((kind, of));
        }
        self.install(pair, of, CoreId::ALL[usize::from(core)]);
        true
    }

    /// Ends all faults.
    pub(crate) fn clear(&mut self, pair: &mut SimPair) {
        self.present.clear();
        *self.trajectories.borrow_mut() = [None, None];
        for of in SystemId::ALL {
            CoreId::ALL
                .into_iter()
                .for_each(|core| self.install(pair, of, core));
        }
    }

    fn install(&self, pair: &mut SimPair, of: SystemId, core: CoreId) {
        let parts = |sent: bool| -> Vec<Bend> {
            let bend = |(kind, system): &(Kind, SystemId)| match *kind {
                Kind::WrongValue(wrong) if *system == of => Some(Bend::new(wrong)),
                _ => None,
            };
            let bends = self.present.iter().filter_map(bend);
            let is_here = |bend: &Bend| {
                let wrong = bend.what();
                wrong.core() == core && wrong.signal.is_sent() == sent
            };
            bends.filter(is_here).collect()
        };
        pair.filter_heard(of, core, filter(parts(false)));
        pair.filter_sent(of, core, filter(parts(true)));
    }
}

fn filter(mut bends: Vec<Bend>) -> Option<tandem_board_sim::Filter> {
    if bends.is_empty() {
        return None;
    }
    Some(Box::new(move |now, frame: CanFrame| {
        let CanId::Standard(id) = frame.id() else {
            return Some(frame);
        };
        let mut data = frame.data().to_vec();
        for bend in &mut bends {
            bend.frame(now, id.into(), &mut data);
        }
        CanFrame::new(frame.id(), true, &data).ok()
    }))
}

/// Creates a core 2 whose trajectories may be bent: each new one is overwritten in shared memory
/// before core 0 runs.
pub(crate) fn planner(
    board: &'static SimBoard,
    mut core: Poller,
    trajectories: Trajectories,
) -> Poller {
    let mut bent = None;
    Box::new(move |polled| {
        let next = core(polled);
        let of = board.identity().system;
        if let Some(bend) = &mut trajectories.borrow_mut()[of.index()] {
            let _none = overwrite(board, bend, &mut bent);
        }
        next
    })
}

fn overwrite(board: &SimBoard, bend: &mut Bend, bent: &mut Option<u32>) -> Option<()> {
    let lmu = ControllerMap::attach(board).ok()?;
    let (_, right) = TRAJECTORY.reader(&lmu.map).ok()?.read().ok()?;
    if bent.replace(right.cycle) == Some(right.cycle) {
        return None;
    }
    let published = words(&right);
    let wrong = words(&wrong(right, bend, board.now()));
    let is_here = |place: &&[LmuWord]| {
        let mut pairs = place.iter().zip(&published);
        pairs.all(|(word, expected)| word.load(Relaxed) == *expected)
    };
    let place = board.lmu().windows(published.len()).find(is_here)?;
    for (word, value) in place.iter().zip(wrong) {
        word.store(value, Relaxed);
    }
    Some(())
}

fn words(trajectory: &Trajectory) -> Vec<u32> {
    let mut words = vec![];
    trajectory.store(&mut |word| words.push(word));
    words
}

/// Bends the place across the road; a factor and a sign also bend heading and curvature, and a
/// value that is stuck or late all parts.
fn wrong(mut trajectory: Trajectory, bend: &mut Bend, now: Instant) -> Trajectory {
    let WrongValue { how, .. } = bend.what();
    let all = matches!(how, How::Stuck | How::LateMs);
    let shape = all || matches!(how, How::Factor | How::Sign);
    for (index, point) in (0_u32..).zip(&mut trajectory.points) {
        let TrajectoryPoint {
            x,
            y,
            heading,
            curvature,
            speed,
            acceleration,
        } = point;
        let parts = [
            (true, y),
            (shape, heading),
            (shape, curvature),
            (all, x),
            (all, speed),
            (all, acceleration),
        ];
        for (part, (is_bent, value)) in (0..).zip(parts) {
            if is_bent {
                *value = bend.value(now, index * 8 + part, f64::from(*value)) as f32;
            }
        }
    }
    trajectory
}
