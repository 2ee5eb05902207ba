//! What observers need of a recording as it grows.
//!
//! Nine in ten entries are records of schedulers, of which observers see little. Those who publish
//! are not optimised, so the entries are sorted out and decoded here.

use tandem_board::{CoreAddress, Traced};
use tandem_cores::trace::Event;
use tandem_record::clocks::begins_control_cycle;
use tandem_record::{Entry, file};

/// Moves the whole entries at the beginning of `bytes` to `into`, in order, without the records of
/// schedulers. Of these it moves the start of each control cycle, and first the newest one of each
/// core, which shows that the core runs while the entries after it are published.
pub fn select(bytes: &mut Vec<u8>, into: &mut Vec<u8>) {
    let begin = into.len();
    let mut newest = [None; CoreAddress::COUNT];
    let mut rest = &bytes[..];
    while let Some(end) = file::whole_entries(rest, 0) {
        let (entry, after) = rest.split_at(end);
        rest = after;
        match file::traced(entry).filter(is_only_scheduling) {
            Some(of) => newest[CoreAddress::new(of.system, of.core).index()] = Some(entry),
            None => into.extend_from_slice(entry),
        }
    }
    let newest: Vec<u8> = newest.into_iter().flatten().flatten().copied().collect();
    into.splice(begin..begin, newest);
    let taken = bytes.len() - rest.len();
    bytes.drain(..taken);
}

/// Passes each entry of these bytes to `into`.
///
/// # Errors
/// If the bytes are not whole valid entries.
pub fn read(bytes: &[u8], into: &mut dyn FnMut(Entry)) -> anyhow::Result<()> {
    file::parse(bytes, into)
}

fn is_only_scheduling(traced: &Traced) -> bool {
    let event = Event::decode(traced.record);
    event.is_some_and(|event| event.is_scheduling() && !begins_control_cycle(event))
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_board::{CoreId, Instant, SystemId};
    use tandem_cores::task_table::TaskCode;
    use tandem_cores::trace::{Begin, Leaves};

    /// Observers see that a core runs, when its control cycles begin, and all but scheduling.
    #[test]
    fn records_of_schedulers_are_left_out() {
        let (roles, control) = (TaskCode::ROLES, TaskCode::CONTROL);
        let begin = Begin::Released {
            late_ns: 0,
            missed: 0,
        };
        let leaves = Leaves::Done;
        let events = [
            Event::TaskIn { task: roles, begin },
            Event::TaskIn {
                task: control,
                begin,
            },
            Event::LinesSplit,
            Event::TaskOut {
                task: control,
                leaves,
            },
            Event::TaskOut {
                task: roles,
                leaves,
            },
        ];
        let mut bytes = vec![];
        for (at_ns, event) in (0..).zip(events) {
            for core in [CoreId::CONTROL, CoreId::PERCEPTION] {
                let traced = Traced {
                    at: Instant::from_ns(at_ns),
                    system: SystemId::B,
                    core,
                    record: event.encode(),
                };
                Entry::Trace(traced).write(&mut bytes).unwrap();
            }
        }
        // A part of an entry stays.
        bytes.push(7);
        let (mut selected, mut passed) = (vec![], vec![]);
        select(&mut bytes, &mut selected);
        read(&selected, &mut |entry| {
            if let Entry::Trace(traced) = entry {
                passed.push((traced.core, Event::decode(traced.record).unwrap()));
            }
        })
        .unwrap();
        let both = |event| [CoreId::CONTROL, CoreId::PERCEPTION].map(|core| (core, event));
        assert_eq!(passed, [4, 1, 2].map(|index| both(events[index])).concat());
        assert_eq!(bytes, [7]);
    }
}
