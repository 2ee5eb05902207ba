//! A core that is held up between looking at the clock and acting.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::sync::atomic::AtomicU32;
use tandem_board::{
    Board, CoreId, Duration, Identity, Instant, ResetCause, ResetRequest, RoleLamp, Supply,
    SystemId, TraceRecord, Wake,
};
use tandem_board_sim::{Config, SimBoard, SimPair};
use tandem_cores::Core;
use tandem_cores::core0::Core0;
use tandem_sim::drive::poller;

/// How long the core is held up.
const SPAN: Duration = Duration::from_ms(8);
/// Before which service.
const SERVICE: usize = 20;

/// A board whose core is held up, once, right before it services the watchdog.
struct HeldUp {
    board: SimBoard,
    supply: Dog,
}

struct Dog {
    board: SimBoard,
    /// By how much this core's time is ahead of the simulation's, which stands still during a poll.
    ahead: Cell<Duration>,
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

impl Board for HeldUp {
    type Can = <SimBoard as Board>::Can;
    type Lines = <SimBoard as Board>::Lines;
    type Link = <SimBoard as Board>::Link;
    type Flash = <SimBoard as Board>::Flash;
    type Supply = Dog;

    fn identity(&self) -> Identity {
        self.board.identity()
    }

    fn now(&self) -> Instant {
        self.supply.now()
    }

    fn lmu(&self) -> &[AtomicU32] {
        self.board.lmu()
    }

    fn ring(&self, to: CoreId) {
        self.board.ring(to);
    }

    fn release_core(&self, core: CoreId) {
        self.board.release_core(core);
    }

    fn wait(&self, deadline: Instant) -> Wake {
        self.board.wait(deadline)
    }

    fn can(&self) -> &Self::Can {
        self.board.can()
    }

    fn lines(&self) -> &Self::Lines {
        self.board.lines()
    }

    fn link(&self) -> &Self::Link {
        self.board.link()
    }

    fn flash(&self) -> &Self::Flash {
        self.board.flash()
    }

    fn supply(&self) -> &Dog {
        &self.supply
    }

    fn trace(&self, record: TraceRecord) {
        self.board.trace(record);
    }
}

/// T-CHIP-6: a service that came late, after core 0 had looked at the clock for it, is not followed
/// by one before the window opens again.
#[test]
fn a_core_held_up_before_its_service_does_not_serve_early_after_it() {
    let services = Rc::new(RefCell::new(vec![]));
    let log = Rc::clone(&services);
    let mut pair = SimPair::new(Config::default(), move |board| {
        let of = board.identity();
        if (of.system, of.core) != (SystemId::A, CoreId::CONTROL) {
            return poller(board, tandem_cores::Config::rt());
        }
        let held_up: &'static HeldUp = Box::leak(Box::new(HeldUp {
            board: board.clone(),
            supply: Dog {
                board: board.clone(),
                ahead: Cell::new(Duration::ZERO),
                services: Rc::clone(&log),
            },
        }));
        let mut core = Core0::new(held_up, tandem_cores::Config::rt());
        Box::new(move |_| {
            let deadline = core.poll();
            let ahead = held_up.supply.ahead.get();
            Instant::from_ns(deadline.as_ns() - ahead.as_ns())
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
