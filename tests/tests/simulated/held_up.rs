//! Tests of a core that is held up between reading the clock and acting.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use tandem_board::{
    Board, CoreId, Duration, Instant, ResetCause, ResetRequest, RoleLamp, Supply, SystemId,
};
use tandem_board_sim::{Config, SimBoard, SimPair};
use tandem_cores::core0::{Core0, Core0Task};
use tandem_cores::trace::Event;
use tandem_cores::{Config as Core0Config, Core};
use tandem_sim::drive::{Drive, poller};
use tandem_tests::around::Around;

/// Duration for which the core is held up.
const SPAN: Duration = Duration::from_ms(8);
/// Number of watchdog services before the core is held up.
const SERVICE: usize = 20;

/// A supply that holds its core up once, just before a watchdog service.
struct Dog {
    board: SimBoard,
    /// Lead of this core's clock over the simulation's, which does not advance in a poll.
    ahead: Rc<Cell<Duration>>,
    services: Rc<RefCell<Vec<Instant>>>,
}

impl Dog {
    fn now(&self) -> Instant {
        self.board.now() + self.ahead.get()
    }
}

impl Supply for Dog {
    const WINDOW_OPENS_US: u32 = <SimBoard as Board>::Supply::WINDOW_OPENS_US;
    const WINDOW_CLOSES_US: u32 = <SimBoard as Board>::Supply::WINDOW_CLOSES_US;
    const FIRST_SERVICE_US: u32 = <SimBoard as Board>::Supply::FIRST_SERVICE_US;

    fn reset_cause(&self) -> ResetCause {
        self.board.supply().reset_cause()
    }

    fn starts(&self) -> u8 {
        self.board.supply().starts()
    }

    fn confirm_start(&self) {
        self.board.supply().confirm_start();
    }

    fn watchdog_question(&self) -> u8 {
        if self.services.borrow().len() == SERVICE {
            self.ahead.set(SPAN);
        }
        self.board.supply().watchdog_question()
    }

    fn service_watchdog(&self, answer: u8) {
        self.services.borrow_mut().push(self.now());
        self.board.supply().service_watchdog(answer);
    }

    fn request_reset(&self, request: ResetRequest) {
        self.board.supply().request_reset(request);
    }

    fn show_role(&self, lamp: RoleLamp) {
        self.board.supply().show_role(lamp);
    }
}

/// T-CHIP-6: core 0 services the watchdog late, because it was held up after reading the clock.
/// Its next service still waits until the window opens.
#[test]
fn a_core_held_up_before_its_service_does_not_serve_early_after_it() {
    let services = Rc::new(RefCell::new(vec![]));
    let log = Rc::clone(&services);
    let mut pair = SimPair::new(Config::default(), move |board| {
        let of = board.identity();
        if (of.system, of.core) != (SystemId::A, CoreId::CONTROL) {
            return poller(board, tandem_cores::Config::rt());
        }
        let ahead = Rc::<Cell<Duration>>::default();
        let supply = Dog {
            board: board.clone(),
            ahead: Rc::clone(&ahead),
            services: Rc::clone(&log),
        };
        let (can, link) = (board.can().clone(), board.link().clone());
        let held_up = Around::leaked_ahead(board, can, link, supply, Rc::clone(&ahead));
        let mut core = Core0::new(held_up, tandem_cores::Config::rt());
        Box::new(move |_| {
            let deadline = core.poll();
            Instant::from_ns(deadline.as_ns() - ahead.get().as_ns())
        })
    });
    pair.power_on(SystemId::A);
    pair.run_for(Duration::from_ms(500));
    let services = services.borrow();
    let opens = Duration::from_us(u64::from(Dog::WINDOW_OPENS_US));
    assert!(services.len() > 2 * SERVICE, "{} services", services.len());
    for pair in services.windows(2) {
        let distance = pair[1].since(pair[0]);
        assert!(distance >= opens, "{distance:?} at {:?}", pair[0]);
    }
}

/// T-RED-8: core 0 without a kernel runs each task to its end. As standby it does not begin the
/// longest one, trajectory input, within half a millisecond before it takes over.
#[test]
fn no_long_task_begins_shortly_before_a_takeover() {
    let of_b = |drive: &Drive, wanted: fn(&Event) -> bool| {
        let of = |it: &&_| matches!(it, (_, SystemId::B, CoreId::CONTROL, event) if wanted(event));
        drive
            .events
            .iter()
            .filter(of)
            .map(|it| it.0)
            .collect::<Vec<_>>()
    };
    let is_input = |event: &Event| {
        let code = Core0Task::TrajectoryInput.info().code;
        matches!(event, Event::TaskIn { task, .. } if *task == code)
    };
    // In step, a trajectory arrives at a whole millisecond. With this limit the takeover is 0.3 ms
    // after one.
    let started = || {
        Drive::with("free-lane", 5, |board| {
            let mut config = Core0Config::chip();
            config.redundancy.heartbeat_jitter = Duration::from_us(300);
            poller(board, config)
        })
    };
    let mut sound = started();
    sound.run_for(Duration::from_ms(1_500));
    let arrives = *of_b(&sound, is_input).last().expect("a trajectory");
    let mut waited = 0;
    for before_us in (1_000..4_000).step_by(100) {
        let mut drive = started();
        let until = arrives.since(drive.pair.now()) - Duration::from_us(before_us);
        drive.run_for(until);
        drive.pair.power_off(SystemId::A);
        drive.run_for(Duration::from_ms(20));
        let took = of_b(&drive, |event| matches!(event, Event::TookOver { .. }))[0];
        let is_near = |at: &&Instant| **at < took && took.since(**at) <= Duration::from_us(500);
        let inputs = of_b(&drive, is_input);
        assert_eq!(inputs.iter().find(is_near), None, "{before_us} us");
        waited += usize::from(is_near(&&arrives));
    }
    println!("waited {waited} times");
    assert!(waited > 0, "none arrived shortly before a takeover");
}
