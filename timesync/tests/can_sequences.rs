//! Every sequence of four faults on SYNC and FUP: no sample has a wrong time. S-4
#![allow(clippy::unwrap_used)]

mod exhaustive;

use exhaustive::no_sequence_gives_a_wrong_sample;
use tandem_board::{Instant, SystemId};
use tandem_timesync::{
    Arbitrary, CanTimeCrc, CanTimeFrame, CanTimeMaster, CanTimeSlave, GlobalTime,
};

const US: u64 = 1_000;
const MS: u64 = 1_000_000;

/// What happens to one SYNC and its FUP.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Good,
    SyncLost,
    FupLost,
    /// The slave accepts SYNC when the sender does not, and sends it again.
    SyncTwice,
    /// SYNC and FUP come again after FUP.
    BothAgain,
    /// FUP arrives this late, ms: 104 is after the next SYNC.
    FupLate(u64),
    FupFirst,
    /// The slave's stamp of SYNC is late: each time by another span.
    StampLate,
    /// A frame with a right CRC says another time: each time another one.
    SyncForged,
    FupForged,
    /// The other system sends too, another time.
    OtherSends,
    TakenOver,
    MasterRestarts,
    SlaveRestarts,
    /// By 7.7 ms: no sum of leaps and of the spans above is within the tolerance of another one.
    TimeLeaps,
}

const FATES: [Fate; 16] = [
    Fate::Good,
    Fate::SyncLost,
    Fate::FupLost,
    Fate::SyncTwice,
    Fate::BothAgain,
    Fate::FupLate(60),
    Fate::FupLate(104),
    Fate::FupFirst,
    Fate::StampLate,
    Fate::SyncForged,
    Fate::FupForged,
    Fate::OtherSends,
    Fate::TakenOver,
    Fate::MasterRestarts,
    Fate::SlaveRestarts,
    Fate::TimeLeaps,
];

/// Returns SYNC and FUP of a period whose SYNC is on the bus at `at`, when the time is `global`.
fn frames(master: &mut CanTimeMaster, at: u64, global: u64) -> [CanTimeFrame; 2] {
    let (now, time) = (master.due(), GlobalTime::<Arbitrary>::from_ns(global));
    let sync = master.poll(now, time.moved(-(300 * US as i64))).unwrap();
    master.on_sent(Instant::from_ns(at), time, false);
    [sync, master.poll(master.due(), time).unwrap()]
}

/// Returns this frame with another value, and a right CRC: a CRC is linear, so that of an all-zero
/// frame and of one with the difference only differ as the CRCs of the two frames do.
fn forged(frame: CanTimeFrame, byte: usize, by: u8) -> CanTimeFrame {
    const CRC: crc::Crc<u8> = crc::Crc::<u8>::new(&crc::CRC_8_AUTOSAR);
    let mut difference = [0; 7];
    difference[byte - 2] = by;
    let mut frame = frame;
    frame[byte] ^= by;
    frame[1] ^= CRC.checksum(&difference) ^ CRC.checksum(&[0; 7]);
    frame
}

/// Returns of each sample its period and its error, ns.
fn run(fates: &[Fate]) -> Vec<(usize, i64)> {
    let (mut system, mut offset) = (SystemId::A, 1_000_000 * MS);
    let new = |system, at| CanTimeMaster::new(system, true, Instant::from_ns(at));
    let mut master = new(system, 0);
    let mut arrivals = Vec::new();
    for (n, &fate) in fates.iter().enumerate() {
        match fate {
            Fate::MasterRestarts => master = new(system, master.due().as_ns() + 30 * MS),
            Fate::TakenOver => {
                system = system.peer();
                master = new(system, master.due().as_ns() + 30 * MS);
            }
            Fate::TimeLeaps => offset += 7_700 * US,
            _ => {}
        }
        let at = master.due().as_ns() + 300 * US;
        let [sync, fup] = frames(&mut master, at, offset + at);
        let by = n as u8 + 1;
        let mut add = |at: u64, frame| arrivals.push((at, n, system, frame, offset));
        match fate {
            Fate::SyncLost => {}
            Fate::SyncForged => add(at, forged(sync, 7, by)),
            Fate::StampLate => add(at + u64::from(by) * MS, sync),
            _ => add(at, sync),
        }
        match fate {
            Fate::FupLost => {}
            Fate::FupForged => add(at + 15 * MS, forged(fup, 4, by)),
            Fate::FupLate(ms) => add(at + ms * MS, fup),
            Fate::FupFirst => add(at - 100 * US, fup),
            _ => add(at + 15 * MS, fup),
        }
        match fate {
            Fate::SyncTwice => add(at - 250 * US, sync),
            Fate::BothAgain => {
                add(at + 20 * MS, sync);
                add(at + 25 * MS, fup);
            }
            Fate::OtherSends => {
                let global = offset + at + 7 * MS;
                let [sync, fup] = frames(&mut new(system.peer(), at), at, global);
                arrivals.push((at + MS, n, system.peer(), sync, offset));
                arrivals.push((at + 6 * MS, n, system.peer(), fup, offset));
            }
            Fate::SlaveRestarts => add(at + 50 * MS, [0; 8]),
            _ => {}
        }
    }
    arrivals.sort_by_key(|&(at, ..)| at);
    let (mut slave, mut samples) = (
        CanTimeSlave::<Arbitrary>::new(CanTimeCrc::Validated),
        Vec::new(),
    );
    for (at, n, from, frame, offset) in arrivals {
        if frame == [0; 8] {
            slave = CanTimeSlave::new(CanTimeCrc::Validated);
        }
        if let Ok(Some(time)) = slave.receive(from, Instant::from_ns(at), &frame) {
            let right = GlobalTime::from_ns(time.sample.local.as_ns() + offset);
            samples.push((n, time.sample.global.after(right)));
        }
    }
    samples
}

/// S-4: each run recovers: silence, three samples of a leap, three to learn.
#[test]
fn four_periods_of_all_faults_give_no_wrong_sample() {
    let given = no_sequence_gives_a_wrong_sample(&FATES, (Fate::Good, 4, 10), run);
    assert!(given > 1_000_000, "{given}");
    assert_eq!(run(&[Fate::Good; 9]).len(), 7);
}
