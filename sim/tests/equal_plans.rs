//! Both systems plan the same bits once they have one time, though their clocks drift apart.
#![allow(clippy::unwrap_used)]

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use tandem_board::{Board as _, CoreId, Duration, Instant};
use tandem_board_sim::{Config, Poller, SimBoard};
use tandem_cores::layout::{ControllerMap, SCENE, TRAJECTORY};
use tandem_cores::words::Payload as _;
use tandem_exec::lockstep::{Agreement, OutputDigest, compare};
use tandem_exec::message::ClientId;
use tandem_sim::drive::Drive;
use tandem_sim::time_chain::poller;
use tandem_sim::timing::Time;

/// The digests of each system's plans, by their moment in the vehicle's time.
type Plans = Rc<RefCell<[BTreeMap<Instant, u64>; 2]>>;

/// Creates a core 2 whose plans are kept.
fn planner(board: &SimBoard, time: Time, plans: &Plans) -> Poller {
    let (mut core, plans) = (poller(board, time), Rc::clone(plans));
    let system = board.identity().system.index();
    let board: &'static SimBoard = Box::leak(Box::new(board.clone()));
    Box::new(move |polled| {
        let next = core(polled);
        let newest = || {
            let lmu = ControllerMap::attach(board).ok()?;
            let (_, scene) = SCENE.reader(&lmu.map).ok()?.read().ok()?;
            let (_, plan) = TRAJECTORY.reader(&lmu.map).ok()?.read().ok()?;
            let moment = scene.moment.filter(|_| scene.cycle == plan.cycle)?;
            Some((moment, plan))
        };
        if let Some((moment, mut plan)) = newest() {
            // Times and counts of one system.
            (plan.at, plan.measured, plan.cycle) = (Instant::ORIGIN, Instant::ORIGIN, 0);
            let mut digest = OutputDigest::NONE;
            plan.store(&mut |word| digest.add(word));
            plans.borrow_mut()[system].insert(moment, digest.digest());
        }
        next
    })
}

/// Whether the software lockstep finds the plans of both systems equal.
fn agree(plans: [u64; 2]) -> bool {
    let outputs = ClientId::first(2).zip(plans);
    matches!(compare(outputs, 2), Agreement::Agreed { .. })
}

/// E-3, T-CHIP-3: at 20 ppm, with and without times of jobs, wires and frames, the software
/// lockstep finds 95 % of the plans after the first 10 s equal to the bit.
#[test]
fn both_systems_plan_the_same_bits() {
    for (scenario, time) in [("cut-in", Time::Ideal), ("free-lane", Time::Typical)] {
        let plans = Plans::default();
        let mut settings = Config {
            wires: time.wires(),
            ..Config::default()
        };
        settings.clocks[1].drift_ppb = 20_000;
        let kept = Rc::clone(&plans);
        let mut drive = Drive::on_board(scenario, settings, move |board| {
            match board.identity().core {
                CoreId::PLANNING => planner(board, time, &kept),
                _ => poller(board, time),
            }
        });
        drive.run_for(Duration::from_ms(20_000));
        let [a, b] = &*plans.borrow();
        let settled = a.keys().next().copied().unwrap() + Duration::from_ms(10_000);
        let later: Vec<_> = a.range(settled..).collect();
        let equal = later
            .iter()
            .filter(|(at, plan)| b.get(at).is_some_and(|other| agree([**plan, *other])));
        let (equal, all) = (equal.count(), later.len());
        println!("{scenario}, {time:?}: {equal} of {all}");
        assert!(
            all > 180 && equal * 100 >= all * 95,
            "{scenario}: {equal} of {all}"
        );
    }
}
