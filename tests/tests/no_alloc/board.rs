//! The simulated board. Its own allocations are not counted as the core's.

use crate::allocator::uncounted;
use std::sync::atomic::AtomicU32;
use tandem_board::{
    Board, Can, CanErrors, CanFrame, Channel, CoreId, DataFlash, Datagram, Edge, FlashError,
    FlashStatus, Identity, Instant, Line, Lines, Link, LinkFull, Network, NetworkAddress,
    NetworkFull, Received, Recipient, ResetCause, ResetRequest, RoleLamp, Supply, TimeEdge,
    TraceRecord, TransmitFull, Wake,
};
use tandem_board_sim::SimBoard;

/// Passes every call to the simulated board, uncounted. It implements CAN, lines, link, network,
/// flash and supply itself.
pub(crate) struct Counted<'a> {
    board: &'a SimBoard,
}

impl<'a> Counted<'a> {
    pub(crate) fn new(board: &'a SimBoard) -> Self {
        Self { board }
    }
}

impl Board for Counted<'_> {
    type Can = Self;
    type Lines = Self;
    type Link = Self;
    type Network = Self;
    type Flash = Self;
    type Supply = Self;

    fn identity(&self) -> Identity {
        uncounted(|| self.board.identity())
    }

    fn now(&self) -> Instant {
        uncounted(|| self.board.now())
    }

    fn lmu(&self) -> &[AtomicU32] {
        uncounted(|| self.board.lmu())
    }

    fn ring(&self, to: CoreId) {
        uncounted(|| self.board.ring(to));
    }

    fn release_core(&self, core: CoreId) {
        uncounted(|| self.board.release_core(core));
    }

    fn wait(&self, deadline: Instant) -> Wake {
        uncounted(|| self.board.wait(deadline))
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

    fn trace(&self, record: TraceRecord) {
        uncounted(|| self.board.trace(record));
    }
}

impl Can for Counted<'_> {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        uncounted(|| self.board.can().try_send(frame))
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        uncounted(|| self.board.can().try_send_stamped(frame))
    }

    fn stamp(&self) -> Option<Instant> {
        uncounted(|| self.board.can().stamp())
    }

    fn discard_unsent(&self) {
        uncounted(|| self.board.can().discard_unsent());
    }

    fn try_receive(&self) -> Option<Received> {
        uncounted(|| self.board.can().try_receive())
    }

    fn wake_on_receive(&self, on: bool) {
        uncounted(|| self.board.can().wake_on_receive(on));
    }

    fn overruns(&self) -> u32 {
        uncounted(|| self.board.can().overruns())
    }

    fn errors(&self) -> CanErrors {
        uncounted(|| self.board.can().errors())
    }
}

impl Lines for Counted<'_> {
    fn send(&self, line: Line, edge: Edge) {
        uncounted(|| self.board.lines().send(line, edge));
    }

    fn received(&self, line: Line, edge: Edge) -> u32 {
        uncounted(|| self.board.lines().received(line, edge))
    }

    fn time_edge(&self) -> Option<TimeEdge> {
        uncounted(|| self.board.lines().time_edge())
    }

    fn peer_powered(&self) -> bool {
        uncounted(|| self.board.lines().peer_powered())
    }
}

impl Link for Counted<'_> {
    const MAX_WORDS: usize = <SimBoard as Board>::Link::MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        uncounted(|| self.board.link().try_send(words))
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        uncounted(|| self.board.link().try_receive(words))
    }
}

impl Network for Counted<'_> {
    fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        uncounted(|| self.board.network().address(channel))
    }

    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        uncounted(|| self.board.network().try_send(channel, to, bytes))
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        uncounted(|| self.board.network().sent_at(channel))
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        uncounted(|| self.board.network().try_receive(channel, bytes))
    }
}

impl DataFlash for Counted<'_> {
    const PAGE_BYTES: u32 = <SimBoard as Board>::Flash::PAGE_BYTES;
    const SECTOR_BYTES: u32 = <SimBoard as Board>::Flash::SECTOR_BYTES;
    const SECTORS: u32 = <SimBoard as Board>::Flash::SECTORS;

    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        uncounted(|| self.board.flash().read(offset, into))
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        uncounted(|| self.board.flash().start_erase(sector))
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        uncounted(|| self.board.flash().start_program(offset, data))
    }

    fn status(&self) -> FlashStatus {
        uncounted(|| self.board.flash().status())
    }
}

impl Supply for Counted<'_> {
    const WINDOW_OPENS_US: u32 = <SimBoard as Board>::Supply::WINDOW_OPENS_US;
    const WINDOW_CLOSES_US: u32 = <SimBoard as Board>::Supply::WINDOW_CLOSES_US;
    const FIRST_SERVICE_US: u32 = <SimBoard as Board>::Supply::FIRST_SERVICE_US;

    fn reset_cause(&self) -> ResetCause {
        uncounted(|| self.board.supply().reset_cause())
    }

    fn starts(&self) -> u8 {
        uncounted(|| self.board.supply().starts())
    }

    fn confirm_start(&self) {
        uncounted(|| self.board.supply().confirm_start());
    }

    fn watchdog_question(&self) -> u8 {
        uncounted(|| self.board.supply().watchdog_question())
    }

    fn service_watchdog(&self, answer: u8) {
        uncounted(|| self.board.supply().service_watchdog(answer));
    }

    fn request_reset(&self, request: ResetRequest) {
        uncounted(|| self.board.supply().request_reset(request));
    }

    fn show_role(&self, lamp: RoleLamp) {
        uncounted(|| self.board.supply().show_role(lamp));
    }
}
