//! One suite over the transports of topics: the LMU, iceoryx2 and DDS.
//!
//! Each case is a process of its own. It is forked, which is sound only in a process with one
//! thread: the cases run one after the other. `faulty` shows that each case can fail.
#![forbid(unsafe_code)]
#![allow(clippy::unwrap_used)]

mod dds;
mod faulty;
mod iceoryx2;
mod lmu;
mod suite;
mod topic;

use libtest_mimic::{Arguments, Trial};
use std::io;
use std::process::ExitCode;
use tandem_two_cores::shared::SharedPage;
use tandem_two_cores::worker::{BatchPart, perform};
use topic::Transport;

/// Names a case of the suite, and its function for a transport.
type Case<R> = (&'static str, fn(&R));

/// The cases of a transport with shared memory.
fn in_shared_memory<R: Transport>() -> Vec<Case<R>> {
    let mut cases = everywhere();
    cases.push(("a_value_is_read_where_it_was_written", suite::in_place));
    cases
}

/// The cases of every transport.
fn everywhere<R: Transport>() -> Vec<Case<R>> {
    vec![
        ("a_value_arrives_as_it_was", suite::equal),
        ("values_arrive_in_order", suite::order),
        ("the_newest_are_kept_and_the_loss_is_counted", suite::newest),
        ("a_late_subscriber_gets_what_is_promised", suite::late),
        ("without_a_publisher_there_is_nothing", suite::silence),
        ("one_that_does_not_take_disturbs_no_other", suite::several),
        ("values_outlive_their_publisher", suite::dropped),
        ("a_publisher_killed_while_it_writes", suite::killed),
    ]
}

/// The cases of a transport that checks what it takes.
fn checked<R: topic::Checked>() -> Vec<Case<R>> {
    vec![("what_is_no_value_counts_as_lost", suite::garbage)]
}

fn trials<R: Transport>(name: &str, cases: Vec<Case<R>>) -> impl Iterator<Item = Trial> {
    let trial = move |(case, run): Case<R>| {
        Trial::test(format!("{name}::{case}"), move || {
            outcome_of(run).unwrap_or_else(|why| panic!("{why}"));
            Ok(())
        })
    };
    cases.into_iter().map(trial).collect::<Vec<_>>().into_iter()
}

/// Runs a case in a process of its own; a panic is an error.
fn outcome_of<R: Transport>(run: fn(&R)) -> io::Result<()> {
    let part = BatchPart::on(0, |_| {
        run(&R::start());
        Ok(())
    });
    perform(&SharedPage::new()?, vec![part])
}

fn main() -> ExitCode {
    // Not a private `/dev/shm`: iceoryx2 keeps one half of a service there, and the other in
    // `/tmp`. A test beside this one that sees only that half takes the service for a broken one.
    let place = tandem_board_host::isolation::enter_shared().unwrap();
    let mut all: Vec<Trial> = trials::<lmu::Lmu<false>>("lmu", in_shared_memory()).collect();
    all.extend(trials::<lmu::Lmu<false>>("lmu", checked()));
    all.extend(trials::<lmu::Lmu<true>>("lmu_from_oldest", everywhere()));
    all.extend(trials::<iceoryx2::Service>("iceoryx2", in_shared_memory()));
    all.extend(trials::<dds::Dds<false>>("dds_volatile", everywhere()));
    all.extend(trials::<dds::Dds<false>>("dds_volatile", checked()));
    all.extend(trials::<dds::Dds<true>>(
        "dds_transient_local",
        everywhere(),
    ));
    all.extend(faulty::trials());
    let mut args = Arguments::from_args();
    args.test_threads = Some(1);
    let conclusion = libtest_mimic::run(&args, all);
    place.wipe();
    conclusion.exit_code()
}
