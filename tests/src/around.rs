//! A simulated board with parts that a test replaces.

use std::cell::Cell;
use std::rc::Rc;
use tandem_board::{
    Board, Can, CoreId, Duration, Identity, Instant, Link, LmuWord, OutputDiagnosis, Supply,
    TraceRecord, Wake,
};
use tandem_board_sim::SimBoard;

/// A board around a simulated one, with another CAN controller, link and supply.
pub struct Around<C, L, S> {
    board: SimBoard,
    can: C,
    link: L,
    supply: S,
    ahead: Rc<Cell<Duration>>,
}

impl<C, L, S> Around<C, L, S> {
    /// Creates a board with these parts. It is leaked, so it exists until the test ends.
    pub fn leaked(board: &SimBoard, can: C, link: L, supply: S) -> &'static Self {
        Self::leaked_ahead(board, can, link, supply, Rc::default())
    }

    /// Creates the same board with a clock that is `ahead` of the simulation's time, which does
    /// not advance during a poll.
    pub fn leaked_ahead(
        board: &SimBoard,
        can: C,
        link: L,
        supply: S,
        ahead: Rc<Cell<Duration>>,
    ) -> &'static Self {
        Box::leak(Box::new(Self {
            board: board.clone(),
            can,
            link,
            supply,
            ahead,
        }))
    }
}

impl<C: Can, L: Link, S: Supply> Board for Around<C, L, S> {
    type Can = C;
    type Lines = <SimBoard as Board>::Lines;
    type Link = L;
    type Network = <SimBoard as Board>::Network;
    type Flash = <SimBoard as Board>::Flash;
    type Supply = S;

    fn identity(&self) -> Identity {
        self.board.identity()
    }

    fn now(&self) -> Instant {
        self.board.now() + self.ahead.get()
    }

    fn lmu(&self) -> &[LmuWord] {
        self.board.lmu()
    }

    fn ring(&self, to: CoreId) {
        self.board.ring(to);
    }

    fn release_core(&self, core: CoreId) {
        self.board.release_core(core);
    }

    fn output_diagnosis(&self) -> OutputDiagnosis {
        self.board.output_diagnosis()
    }

    fn wait(&self, deadline: Instant) -> Wake {
        self.board.wait(deadline)
    }

    fn can(&self) -> &C {
        &self.can
    }

    fn lines(&self) -> &Self::Lines {
        self.board.lines()
    }

    fn link(&self) -> &L {
        &self.link
    }

    fn network(&self) -> &Self::Network {
        self.board.network()
    }

    fn flash(&self) -> &Self::Flash {
        self.board.flash()
    }

    fn supply(&self) -> &S {
        &self.supply
    }

    fn trace(&self, record: TraceRecord) {
        self.board.trace(record);
    }
}
