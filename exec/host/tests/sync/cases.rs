//! Deaths, freezes, restarts and lies.

use rustix::process::Signal;

use crate::group::{CONFIG, Group, SHORT, activations, check_all};

type Case = (&'static str, fn());

pub(crate) const ALL: &[Case] = &[
    ("codes_come_in_order_and_are_equal_in_all_clients", in_order),
    ("a_lost_service_leads_all_back_to_discovery", lost_service),
    (
        "a_killed_master_has_the_next_candidate_as_successor",
        killed_master,
    ),
    (
        "a_frozen_master_that_wakes_decides_nothing_twice",
        frozen_master,
    ),
    (
        "a_killed_client_is_told_and_joins_after_its_restart",
        killed_client,
    ),
    ("a_frozen_client_is_told_what_it_missed", frozen_client),
    ("a_lying_client_holds_nothing_up", lying_client),
    (
        "of_three_the_deviating_client_is_excluded_until_it_restarts",
        deviating_client,
    ),
    ("two_that_differ_stop_in_the_safe_state", two_differ),
    ("too_few_clients_stop_in_the_safe_state", too_few),
    ("garbage_in_all_words_stops_no_process_by_panic", garbage),
];

/// E-1: RegisterServices, ServiceDiscovery, Init, Run …, Terminate; equal times and random numbers.
fn in_order() {
    let group = Group::new(CONFIG);
    let _master = group.master(0);
    let mut clients = group.clients(["done@40"; 3]);
    clients.iter_mut().for_each(|client| client.finish());
    assert!(check_all(clients.iter().map(|client| &client.told)) >= 41);
    for client in &clients {
        let told = activations(&client.told);
        let codes: Vec<&str> = told.iter().map(|one| one.code.as_str()).collect();
        assert_eq!(
            codes[..4],
            ["RegisterServices", "ServiceDiscovery", "Init", "Run"]
        );
        assert_eq!(codes.last(), Some(&"Terminate"));
        assert!(codes[3..codes.len() - 1].iter().all(|code| *code == "Run"));
        assert!(told.iter().all(|one| one.standing == "Member"), "{told:?}");
    }
}

/// E-1: a service that one member lost leads all back to ServiceDiscovery, in the same cycle.
fn lost_service() {
    let group = Group::new(CONFIG);
    let _master = group.master(0);
    let mut clients = group.clients(["done@30", "lost@10,done@30", "done@30"]);
    clients.iter_mut().for_each(|client| client.finish());
    check_all(clients.iter().map(|client| &client.told));
    for client in &clients {
        let told = activations(&client.told);
        let codes: Vec<&str> = told[9..13].iter().map(|one| one.code.as_str()).collect();
        assert_eq!(codes, ["Run", "ServiceDiscovery", "Init", "Run"]);
    }
}

/// E-3: the next candidate continues, and no client sees two answers for one cycle.
fn killed_master() {
    let group = Group::new(CONFIG);
    let (first, mut second) = (group.master(0), group.master(1));
    let mut clients = group.clients(["-"; 3]);
    clients[0].skip(20);
    drop(first);
    second.until_has("Master(ClientId(1))");
    clients[0].skip(20);
    // The dead one comes back, and its successor dies.
    let mut first = group.master(0);
    clients[0].skip(20);
    drop(second);
    first.until_has("Master(ClientId(0))");
    clients[0].skip(20);
    let told = clients.map(crate::group::Process::kill);
    assert!(check_all(&told) >= 80);
}

/// E-3: a master that is frozen, also between its proposal and its decision, wakes too late.
fn frozen_master() {
    let group = Group::new(CONFIG);
    let mut masters = [group.master(0), group.master(1)];
    let mut clients = group.clients(["-"; 3]);
    clients[0].skip(10);
    for round in 0..6 {
        let [frozen, other] = [round % 2, 1 - round % 2];
        masters[frozen].signal(Signal::STOP);
        masters[other].until_has(&format!("Master(ClientId({other}))"));
        clients[0].skip(3);
        masters[frozen].signal(Signal::CONT);
        clients[0].skip(5);
    }
    let told = clients.map(crate::group::Process::kill);
    assert!(check_all(&told) >= 50);
}

/// E-3: the others continue; the restarted client begins with RegisterServices and joins later.
fn killed_client() {
    let group = Group::new(SHORT);
    let mut master = group.master(0);
    let [mut zero, one, two] = group.clients(["-"; 3]);
    zero.skip(10);
    let before = two.kill();
    master.until_has("Left(ClientId(2))");
    zero.skip(10);
    let mut again = group.client(2, "-");
    master.until_has("Restarted(ClientId(2))");
    again.until_has(" Joining ");
    again.until_has(" Member ");
    let again = again.kill();
    let codes: Vec<_> = activations(&again)
        .into_iter()
        .map(|one| one.code)
        .collect();
    assert_eq!(
        codes[..4],
        ["RegisterServices", "ServiceDiscovery", "Init", "Run"]
    );
    check_all(&[zero.kill(), one.kill(), before, again]);
}

/// E-1, E-3: a frozen client is told as silent; when it wakes it is told how many it missed.
fn frozen_client() {
    let group = Group::new(SHORT);
    let mut master = group.master(0);
    let [mut zero, one, two] = group.clients(["-"; 3]);
    zero.skip(10);
    two.signal(Signal::STOP);
    master.until_has("Silent(ClientId(2))");
    master.until_has("Left(ClientId(2))");
    zero.skip(10);
    two.signal(Signal::CONT);
    master.until_has("Joined(ClientId(2))");
    let two = two.kill();
    assert!(
        activations(&two).iter().any(|one| one.missed >= 3),
        "told as missed"
    );
    check_all(&[zero.kill(), one.kill(), two]);
}

/// E-3: whatever one client writes, the two others are activated and agree.
fn lying_client() {
    let group = Group::new(SHORT);
    let mut master = group.master(0);
    let [mut zero, mut one] = [group.client(0, "-"), group.client(1, "-")];
    let liar = group.liar(2);
    for lie in ["Identity", "Cycle", "Garbage", "Twice"] {
        let lie = format!("Disagrees(ClientId(2), {lie})");
        if !master.told.contains(&lie) {
            master.until_has(&lie);
        }
    }
    zero.skip(40);
    one.skip(0);
    drop(liar);
    assert!(check_all(&[zero.kill(), one.kill()]) >= 40);
    assert!(!master.told.iter().any(|line| line.contains("SafeState")));
}

/// E-3: found in the same cycle, named, and out until it is restarted.
fn deviating_client() {
    let group = Group::new(SHORT);
    let mut master = group.master(0);
    let [mut zero, one, mut two] = group.clients(["-", "-", "flip@15"]);
    master.until_has("Deviates(ClientId(2), 15)");
    let line = two.until_has(" Excluded ");
    assert!(
        line.starts_with("A 16 "),
        "the activation after the wrong output: {line}"
    );
    // Its outputs are right again, and it stays out.
    zero.skip(30);
    let before = two.kill();
    assert!(
        !before
            .iter()
            .skip_while(|told| **told != line)
            .any(|told| told.contains("Member"))
    );
    let mut again = group.client(2, "-");
    master.until_has("Joined(ClientId(2))");
    again.until_has(" Member ");
    check_all(&[zero.kill(), one.kill(), before, again.kill()]);
}

/// E-3: of three one deviates, then one of the two others: nobody can tell which is right.
fn two_differ() {
    let group = Group::new(CONFIG);
    let mut master = group.master(0);
    let mut clients = group.clients(["-", "flip@20", "flip@10"]);
    master.until_has("Deviates(ClientId(2), 10)");
    master.until_has("SafeState");
    for client in &mut clients {
        client.finish();
        let last = client.told.last().unwrap();
        assert!(
            last.starts_with("A 21 Terminate") && last.ends_with("safe-state"),
            "{last}"
        );
    }
    check_all(clients.iter().map(|client| &client.told));
}

/// E-3: one client that is left alone cannot be compared.
fn too_few() {
    let group = Group::new(tandem_exec::master::Config {
        patience: tandem_board::Duration::from_ms(600),
        ..SHORT
    });
    let mut master = group.master(0);
    let [mut zero, one, two] = group.clients(["-"; 3]);
    zero.skip(10);
    drop((one, two));
    master.until_has("SafeState");
    zero.finish();
    assert!(zero.told.last().unwrap().ends_with("safe-state"));
}

/// E-3: shared memory is hostile. Every word is overwritten, again and again, while all run.
fn garbage() {
    let group = Group::new(SHORT);
    let masters = [group.master(0), group.master(1)];
    let mut clients = group.clients(["-"; 3]);
    clients[0].skip(10);
    let mut seed = tandem_exec::client::Random::new(7);
    for _ in 0..200 {
        for word in group.place.words {
            let bits = match seed.draw() % 3 {
                0 => seed.draw() as u32,
                1 => u32::MAX,
                _ => word
                    .load(core::sync::atomic::Ordering::Relaxed)
                    .wrapping_add(1),
            };
            word.store(bits, core::sync::atomic::Ordering::Relaxed);
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    for mut process in masters.into_iter().chain(clients) {
        assert!(process.is_sound());
    }
}
