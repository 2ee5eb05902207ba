//! The parts of the board. Each accesses some of the carrier's registers.

use crate::peripherals::{self, SystemRegisters};
use crate::{hart, interrupts};
use core::sync::atomic::Ordering::{Acquire, Relaxed, Release};
use tandem_board::{
    Can, CanErrors, CanFrame, Channel, CoreAddress, CoreId, DataFlash, Datagram, Edge, FlashError,
    FlashStatus, Instant, Line, Lines, Link, LinkFull, Network, NetworkAddress, NetworkFull,
    Received, Recipient, ResetCause, ResetRequest, RoleLamp, Supply, TimeEdge, TransmitFull,
};
use tandem_peripherals::codec::{
    BusFrame, DATAGRAM_MAX_WORDS, PacketHead, Reach, Sender, decode_datagram, encode_datagram,
    encode_service,
};
use tandem_peripherals::data_flash::{self, Operation};
use tandem_peripherals::stamp::TimeStamp;
use tandem_peripherals::watchdog::{Window, question};

/// Returns the registers of the system of core `of`.
fn system(of: CoreAddress) -> &'static SystemRegisters {
    peripherals::system(of.system)
}

fn must_be_control(of: CoreAddress, what: &str) {
    assert!(of.core == CoreId::CONTROL, "only core 0 {what}");
}

/// The CAN controller of a core.
#[derive(Clone, Copy, Debug)]
pub struct VirtCan(pub(super) CoreAddress);
/// A system's ends of the lines.
#[derive(Clone, Copy, Debug)]
pub struct VirtLines(pub(super) CoreAddress);
/// A system's end of the data link.
#[derive(Clone, Copy, Debug)]
pub struct VirtLink(pub(super) CoreAddress);
/// The Ethernet port of core 0; on the other cores it is not connected.
#[derive(Clone, Copy, Debug)]
pub struct VirtNetwork(pub(super) CoreAddress);
/// The data flash of a system.
#[derive(Clone, Copy, Debug)]
pub struct VirtFlash(pub(super) CoreAddress);
/// The supply of a system.
#[derive(Clone, Copy, Debug)]
pub struct VirtSupply(pub(crate) CoreAddress);

impl VirtCan {
    fn send(&self, frame: &CanFrame, mark: u32) -> Result<(), TransmitFull> {
        let frame = BusFrame {
            received: Received {
                frame: *frame,
                // The bus sets the time.
                at: Instant::from_words([mark, 0]),
            },
            sender: Sender::Core(self.0),
            reach: Reach::ALL,
        };
        if !peripherals::core(self.0).transmit.put(&frame.encode()) {
            return Err(TransmitFull);
        }
        peripherals::call();
        Ok(())
    }
}

impl Can for VirtCan {
    fn try_send(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send(frame, 0)
    }

    fn try_send_stamped(&self, frame: &CanFrame) -> Result<(), TransmitFull> {
        self.send(frame, peripherals::core(self.0).begin_stamp())
    }

    fn stamp(&self) -> Option<Instant> {
        let registers = peripherals::core(self.0);
        TimeStamp(&registers.stamp).read(registers.marks.load(Relaxed))
    }

    fn discard_unsent(&self) {
        peripherals::core(self.0).transmit.discard();
    }

    fn try_receive(&self) -> Option<Received> {
        let words = peripherals::core(self.0).receive.take()?;
        BusFrame::decode(&words).map(|frame| frame.received)
    }

    fn wake_on_receive(&self, on: bool) {
        let registers = peripherals::core(self.0);
        // Release pairs with the Acquire in `broadcast`.
        registers.wake_on_receive.store(on, Release);
        if on && !registers.receive.is_empty() {
            interrupts::post(hart::number());
        }
    }

    fn overruns(&self) -> u32 {
        peripherals::core(self.0).overruns.load(Relaxed)
    }

    fn errors(&self) -> CanErrors {
        CanErrors::from_word(peripherals::core(self.0).can_errors.load(Relaxed))
    }
}

impl Lines for VirtLines {
    fn send(&self, line: Line, edge: Edge) {
        let peer = self.0.system.peer();
        peripherals::system(peer).count_edges((line, edge), 1, peripherals::now);
        if line.interrupts() {
            peripherals::interrupt(peer);
        }
    }

    fn received(&self, line: Line, edge: Edge) -> u32 {
        system(self.0).received(line, edge)
    }

    fn time_edge(&self) -> Option<TimeEdge> {
        system(self.0).time_edge()
    }

    fn peer_powered(&self) -> bool {
        let peer = peripherals::system(self.0.system.peer());
        peer.level_cut.load(Relaxed) || peer.powered.load(Relaxed)
    }
}

impl Link for VirtLink {
    const MAX_WORDS: usize = DATAGRAM_MAX_WORDS;

    fn try_send(&self, words: &[u32]) -> Result<(), LinkFull> {
        let to = peripherals::system(self.0.system.peer());
        match to.link.put(&encode_datagram(words)[..=words.len()]) {
            true => Ok(()),
            false => Err(LinkFull),
        }
    }

    fn try_receive(&self, words: &mut [u32]) -> Option<usize> {
        let datagram = system(self.0).link.take()?;
        Some(decode_datagram(&datagram, words))
    }
}

impl Network for VirtNetwork {
    fn address(&self, channel: Channel) -> Option<NetworkAddress> {
        let is_control = self.0.core == CoreId::CONTROL;
        system(self.0)
            .network
            .address(channel)
            .filter(|_| is_control)
    }

    fn try_send(&self, channel: Channel, to: Recipient, bytes: &[u8]) -> Result<(), NetworkFull> {
        if self.address(channel).is_none() {
            return Ok(());
        }
        if !system(self.0).network.send(channel, to, bytes) {
            return Err(NetworkFull);
        }
        peripherals::call();
        Ok(())
    }

    fn sent_at(&self, channel: Channel) -> Option<Instant> {
        self.address(channel)?;
        system(self.0).network.sent_at(channel)
    }

    fn try_receive(&self, channel: Channel, bytes: &mut [u8]) -> Option<Datagram> {
        self.address(channel)?;
        let words = system(self.0).network.receive[channel.index()].take()?;
        let (head, len) = PacketHead::decode(&words, bytes)?;
        match head.peer {
            Recipient::One(from) => Some(Datagram {
                len,
                from,
                at: head.at,
            }),
            Recipient::Everyone => None,
        }
    }
}

impl DataFlash for VirtFlash {
    const PAGE_BYTES: u32 = data_flash::PAGE_BYTES;
    const SECTOR_BYTES: u32 = data_flash::SECTOR_BYTES;
    const SECTORS: u32 = data_flash::SECTORS;

    fn read(&self, offset: u32, into: &mut [u8]) -> Result<(), FlashError> {
        system(self.0).flash.read(offset, into)
    }

    fn start_erase(&self, sector: u32) -> Result<(), FlashError> {
        must_be_control(self.0, "erases the flash");
        system(self.0).flash.begin(Operation::erase(sector), &[])
    }

    fn start_program(&self, offset: u32, data: &[u8]) -> Result<(), FlashError> {
        must_be_control(self.0, "programs the flash");
        let operation = Operation::program(offset, data.len());
        system(self.0).flash.begin(operation, data)
    }

    fn status(&self) -> FlashStatus {
        match system(self.0).flash.is_busy() {
            true => FlashStatus::Busy,
            false => FlashStatus::Idle,
        }
    }
}

impl Supply for VirtSupply {
    const WINDOW_OPENS_US: u32 = Window::TARGET.opens_us;
    const WINDOW_CLOSES_US: u32 = Window::TARGET.closes_us;
    const FIRST_SERVICE_US: u32 = Window::TARGET.first_us;

    fn reset_cause(&self) -> ResetCause {
        ResetCause::from_code(system(self.0).cause.load(Acquire)).unwrap_or(ResetCause::Trap)
    }

    fn starts(&self) -> u8 {
        system(self.0).starts.load(Relaxed)
    }

    fn confirm_start(&self) {
        system(self.0).starts.store(0, Relaxed);
    }

    fn watchdog_question(&self) -> u8 {
        question(system(self.0).service_count.load(Relaxed))
    }

    fn service_watchdog(&self, answer: u8) {
        must_be_control(self.0, "serves the watchdog");
        let registers = system(self.0);
        // If the queue is full, this service is dropped, because the next one is enough.
        if registers
            .services
            .put(&encode_service(peripherals::now(), answer))
        {
            registers.service_count.fetch_add(1, Relaxed);
            peripherals::call();
        }
    }

    fn request_reset(&self, request: ResetRequest) {
        // Release pairs with the Acquire in the carrier, which then sees all earlier writes.
        let register = &system(self.0).request;
        register.store(1 + request.code(), Release);
        peripherals::call();
    }

    fn show_role(&self, lamp: RoleLamp) {
        system(self.0).lamp.store(lamp.code(), Relaxed);
    }
}
