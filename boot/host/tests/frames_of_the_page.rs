//! The bytes of each frame of the extension, as the tables of `docs/boot.md` have them.
#![allow(clippy::unwrap_used)]

use tandem_board::SystemId;
use tandem_boot::{Answer, HostRequest, Refusal, ReleaseStage};

const A: Option<SystemId> = Some(SystemId::A);
const B: Option<SystemId> = Some(SystemId::B);

/// T-BOOT-3, U-2: a foreign client builds its frames from the page.
#[test]
fn answers_have_the_bytes_of_the_page() {
    let release = |system, stage| Answer::Release {
        system,
        stage,
        version: 0x0403_0201,
    };
    for (answer, bytes) in [
        (
            Answer::Accepted { records: 5 },
            [0x1D, 0x4B, 0x21, 0, 5, 0, 0, 0],
        ),
        (
            Answer::Resend { record: 6 },
            [0x53, 0x4F, 0x53, 0, 6, 0, 0, 0],
        ),
        (
            Answer::Refused(Refusal::Tester),
            [0x4E, 0x45, 0x44, 0, 19, 0, 0, 0],
        ),
        (
            Answer::Window {
                records: 16,
                application: 1,
                configuration: 2,
                accepted: 5,
            },
            [0x57, 16, 1, 2, 5, 0, 0, 0],
        ),
        (
            Answer::Challenge {
                part: 2,
                bytes: [1, 2, 3, 4, 5],
            },
            [0x57, 0x83, 2, 1, 2, 3, 4, 5],
        ),
        (Answer::Proved, [0x57, 0x84, 0, 0, 0, 0, 0, 0]),
        (Answer::Unproved, [0x57, 0x84, 1, 0, 0, 0, 0, 0]),
        (
            Answer::Locked { seconds: 0x102 },
            [0x57, 0x84, 2, 0, 2, 1, 0, 0],
        ),
        (
            Answer::Info {
                question: 0x23,
                detail: 9,
                value: 0x0403_0201,
            },
            [0x57, 0x85, 0x23, 9, 1, 2, 3, 4],
        ),
        (
            release(SystemId::A, ReleaseStage::Trial),
            [0x57, 0x86, 1, 0, 1, 2, 3, 4],
        ),
        (
            release(SystemId::B, ReleaseStage::Approved),
            [0x57, 0x86, 2, 3, 1, 2, 3, 4],
        ),
    ] {
        assert_eq!(answer.encode(), bytes, "{answer:?}");
        assert_eq!(Answer::decode(&bytes), Some(answer));
    }
}

/// T-BOOT-3, T-BOOT-1: the same for the requests of a host. A frame that asks for nothing, or
/// names a third system, is data.
#[test]
fn requests_have_the_bytes_of_the_page() {
    let connect = |system, resume| HostRequest::Connect { system, resume };
    let challenge = |system| HostRequest::Challenge {
        system,
        key: 3,
        part: 2,
    };
    let proof = |system| HostRequest::Proof {
        system,
        part: 12,
        bytes: [1, 2, 3, 4, 0],
    };
    for (request, bytes) in [
        (connect(None, false), [0x2D, 0x57, 0x3E, 8, 0, 0, 0, 0]),
        (connect(A, false), [0x2D, 0x57, 0x3E, 8, 1, 0, 0, 0]),
        (connect(B, true), [0x2D, 0x57, 0x3E, 8, 2, 1, 0, 0]),
        (
            HostRequest::Offer { records: 8 },
            [0x57, 1, 8, 0, 0, 0, 0, 0],
        ),
        (
            HostRequest::GoBack { record: 7 },
            [0x57, 2, 0, 0, 7, 0, 0, 0],
        ),
        (challenge(None), [0x57, 3, 3, 2, 0, 0, 0, 0]),
        (challenge(B), [0x57, 3, 3, 2, 2, 0, 0, 0]),
        (proof(None), [0x57, 4, 12, 1, 2, 3, 4, 0]),
        (proof(A), [0x57, 4, 0x1C, 1, 2, 3, 4, 0]),
        (proof(B), [0x57, 4, 0x2C, 1, 2, 3, 4, 0]),
        (
            HostRequest::Info {
                system: A,
                question: 0x23,
            },
            [0x57, 5, 0x23, 0, 1, 0, 0, 0],
        ),
        (
            HostRequest::RollBack { system: B },
            [0x57, 6, 0, 0, 2, 0, 0, 0],
        ),
    ] {
        let frame = request.frame().unwrap();
        assert_eq!(frame.data(), bytes, "{request:?}");
        assert_eq!(HostRequest::decode(&bytes), request);
    }
    for strange in [
        [0x2D, 0x57, 0x3E, 8, 3, 0, 0, 0],
        [0x2D, 0x57, 0x3E, 8, 1, 2, 0, 0],
        [0x2D, 0x57, 0x3E, 8, 1, 0, 1, 0],
        [0x57, 1, 0, 0, 0, 0, 0, 0],
        [0x57, 3, 3, 2, 3, 0, 0, 0],
        [0x57, 4, 0x3C, 1, 2, 3, 4, 0],
        [0x57, 5, 0x23, 0, 3, 0, 0, 0],
        [0x57, 6, 0, 0, 3, 0, 0, 0],
        [0x57, 7, 0, 0, 0, 0, 0, 0],
    ] {
        let request = HostRequest::decode(&strange);
        assert_eq!(request, HostRequest::Data(&strange), "{strange:X?}");
    }
}
