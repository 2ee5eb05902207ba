//! The cases, by part of the board.

mod can;
mod clock;
mod doorbell;
mod fault;
mod flash;
mod lines;
mod link;
mod lmu;
mod network;
mod release;
mod supply;

use crate::case::{Case, CasePart, Setting};
pub use fault::case_of;
use tandem_board::{CoreAddress, FaultSource};

use Setting::{Plain, Releases, Restarts, Suspends, Watchdog};

/// Number of cases in the suite.
const COUNT: usize = 65;

/// Makes a case whose parts have static lifetime.
macro_rules! case {
    ($name:literal, $setting:ident, $($place:ident: $role:path),+ $(,)?) => {
        Case {
            name: $name,
            setting: $setting,
            parts: const { &[$(CasePart { place: CoreAddress::$place, role: $role }),+] },
        }
    };
}

/// Returns all cases, ordered so that a case relies only on properties that earlier cases tested.
#[must_use]
#[rustfmt::skip]
pub fn cases<B: FaultSource + 'static>() -> [Case<B>; COUNT] {
    [
        case!("release-one-by-one", Releases,
            A0: release::releases::<B>, A1: release::released::<B>, A2: release::released::<B>),
        case!("clock-monotonic", Plain, A0: clock::monotonic::<B>),
        case!("clock-deadline", Plain, A0: clock::deadline::<B>,
            B0: release::nothing_more::<B>, B1: clock::deadline::<B>),
        case!("clock-past-deadline", Plain, A0: clock::past_deadline::<B>),
        case!("clock-shared", Plain, A0: clock::shared::<B>, A1: clock::shared::<B>),
        case!("identity", Plain,
            A0: lmu::identity::<B>, A1: lmu::identity::<B>, A2: lmu::identity::<B>,
            B0: lmu::identity::<B>, B1: lmu::identity::<B>, B2: lmu::identity::<B>),
        case!("lmu-zero", Plain, A0: lmu::zero::<B>, B0: lmu::zero::<B>),
        case!("lmu-shared", Plain,
            A0: lmu::shared::<B>, A1: lmu::shared::<B>, A2: lmu::shared::<B>,
            B0: lmu::apart::<B>),
        case!("lmu-atomic", Plain,
            A0: lmu::atomic::<B>, A1: lmu::atomic::<B>, A2: lmu::atomic::<B>),
        case!("doorbell-before-wait", Plain,
            A0: doorbell::early_ringer::<B>, A1: doorbell::late_waiter::<B>),
        case!("doorbell-wakes", Plain, B0: doorbell::ringer::<B>, B2: doorbell::sleeper::<B>),
        case!("doorbell-merge", Plain,
            A0: doorbell::hasty_ringer::<B>, A1: doorbell::last_value::<B>),
        case!("doorbell-all-pairs", Plain,
            A0: doorbell::relay::<B>, A1: doorbell::relay::<B>, A2: doorbell::relay::<B>),
        case!("doorbell-own", Plain, A0: doorbell::own::<B>,
            B0: release::nothing_more::<B>, B1: doorbell::own::<B>),
        case!("doorbell-absent", Plain, A0: doorbell::absent::<B>),
        case!("can-order", Plain,
            A0: can::order_sender::<B>, A1: can::order_receiver::<B>,
            B0: can::order_receiver::<B>, B1: can::order_receiver::<B>),
        case!("can-one-order", Plain,
            A0: can::chatter::<B>, A1: can::listener::<B>,
            B0: can::chatter::<B>, B1: can::listener::<B>),
        case!("can-not-self", Plain, A0: can::lonely_sender::<B>, A1: can::witness::<B>),
        case!("can-payload", Plain, A0: can::payload_sender::<B>, A1: can::payload_receiver::<B>),
        case!("can-discard", Plain,
            A0: can::discarding_sender::<B>, A1: can::discard_witness::<B>),
        case!("can-stamp", Plain, A0: can::stamping_sender::<B>, A1: can::stamp_witness::<B>),
        case!("can-stamp-reset", Restarts, A0: can::stamps_once::<B>),
        case!("can-wakes", Plain, A0: can::paced_sender::<B>, A1: can::woken_receiver::<B>),
        case!("can-wakes-only-if-asked", Plain,
            A0: can::steady_sender::<B>, A1: can::deaf_sleeper::<B>),
        case!("can-overruns", Plain, A0: can::flood::<B>, A1: can::late_receiver::<B>),
        case!("lines-count", Plain, A0: lines::counter::<B>, B0: lines::counter::<B>),
        case!("lines-start-interrupts", Plain, A0: lines::starter::<B>, B0: lines::started::<B>),
        case!("lines-time", Plain, A0: lines::marker::<B>, B0: lines::marked::<B>),
        case!("lines-time-pairs", Plain,
            A0: lines::hasty_reader::<B>, B0: lines::hasty_marker::<B>),
        case!("lines-time-reset", Restarts,
            A0: lines::marked_once::<B>, B0: lines::marks_once::<B>),
        case!("lines-level", Plain, A0: lines::level::<B>, B0: lines::level::<B>),
        case!("lines-level-reset", Restarts,
            A0: supply::reset_in_sight::<B>, B0: supply::sees_reset::<B>),
        case!("link-order", Plain, A0: link::order::<B>, B0: link::order::<B>),
        case!("link-full", Plain, A0: link::filler::<B>, B0: link::drainer::<B>),
        case!("link-short-buffer", Plain,
            A0: link::long_sender::<B>, B0: link::short_receiver::<B>),
        case!("network-order", Plain, A0: network::order::<B>, B0: network::order::<B>),
        case!("network-everyone", Plain, A0: network::caller::<B>, B0: network::audience::<B>),
        case!("network-short-buffer", Plain,
            A0: network::long_sender::<B>, B0: network::short_receiver::<B>),
        case!("network-full", Plain, A0: network::flood::<B>, B0: network::flooded::<B>),
        case!("network-times", Plain, A0: network::times::<B>, B0: network::times::<B>),
        case!("flash-erase-program", Plain, B0: flash::erase_program::<B>),
        case!("flash-ranges", Plain, A0: flash::ranges::<B>),
        case!("flash-one-at-a-time", Plain, A0: flash::one_at_a_time::<B>),
        case!("flash-no-erase", Plain, A0: flash::no_erase::<B>),
        case!("flash-interrupted", Restarts, A0: flash::interrupted::<B>),
        case!("flash-durable", Restarts, A0: flash::durable::<B>),
        case!("supply-watchdog", Watchdog, A0: supply::good_service::<B>),
        case!("supply-opens", Watchdog, B0: supply::as_early_as_may_be::<B>),
        case!("supply-wrong-answer", Restarts, A0: supply::wrong_answer::<B>),
        case!("supply-early", Restarts, B0: supply::early::<B>),
        case!("supply-late", Restarts, A0: supply::late::<B>),
        case!("supply-never", Restarts, B0: supply::never::<B>),
        case!("supply-software-reset", Restarts,
            A0: supply::software_reset::<B>, A2: supply::bystander::<B>),
        case!("supply-download-reset", Restarts, A0: supply::download_reset::<B>),
        case!("supply-core-dead", Restarts,
            A0: supply::bystander::<B>, A1: supply::reports_core_dead::<B>),
        case!("supply-suspend", Suspends, A0: supply::suspends::<B>, B0: supply::sees_low::<B>),
        case!("fault-outputs", Plain, A0: fault::outputs::<B>),
        case!("fault-can-transmit", Plain,
            A0: fault::cannot_send::<B>, A1: fault::hears_after_repair::<B>),
        case!("fault-can-receive", Plain,
            A0: fault::sends_on::<B>, A1: fault::cannot_receive::<B>),
        case!("fault-can-stamp", Plain,
            A0: fault::stamps_late::<B>, A1: fault::hears_stamped::<B>),
        case!("fault-error-pin", Restarts, A0: fault::error_pin::<B>, B0: fault::error_pin::<B>),
        case!("fault-undervoltage", Restarts,
            A0: fault::undervoltage::<B>, B0: fault::undervoltage::<B>),
        case!("fault-overvoltage", Suspends,
            A0: fault::overvoltage::<B>, B0: fault::overvoltage::<B>),
        case!("fault-network", Plain, A0: network::cut::<B>, B0: network::cut::<B>),
        case!("trace-and-lamp", Plain, A0: supply::trace_and_lamp::<B>),
    ]
}
