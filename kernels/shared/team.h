// CPU threads that share the work of a launch; team.py describes the team.
#pragma once

#if !defined(__CUDA_ARCH__)

#if !defined(_WIN32)
extern "C" {
int pthread_create(unsigned long*, const void*, void* (*)(void*), void*);
int pthread_detach(unsigned long);
int pthread_mutex_init(void*, const void*);
int pthread_mutex_lock(void*);
int pthread_mutex_unlock(void*);
int pthread_cond_init(void*, const void*);
int pthread_cond_wait(void*, void*);
int pthread_cond_signal(void*);
int sched_yield();
}
#endif

namespace warpmag {

typedef unsigned long long Word;

constexpr int MOST_THREADS = 64; // as in team.py
// Takes about 1 ms. A member yields its core between polls.
constexpr int POLLS_BEFORE_SLEEP = 4000;

enum State : Word { GONE, WAITING, ASLEEP, CLAIMED, POSTED, WORKING }; // GONE and ASLEEP as in team.py

struct Member {
    Word state;
    void (*call)(void* job, int number);
    void* job;
    Word number;
    Word padding[4];
    Word lock[8], wake[8]; // storage of a mutex and of a condition variable
};

// Changes a state from ``from`` to ``to``. Returns false, without a change, if the state is another.
inline bool exchange_state(Member* member, Word from, Word to) {
    return __atomic_compare_exchange_n(&member->state, &from, to, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED);
}

inline Word state_of(Member* member) { return __atomic_load_n(&member->state, __ATOMIC_ACQUIRE); }

inline void set_state(Member* member, Word state) { __atomic_store_n(&member->state, state, __ATOMIC_RELEASE); }

inline void yield_thread() {
#if !defined(_WIN32)
    sched_yield();
#endif
}

#if defined(_WIN32)
inline void start_members(int, Word*) {}

template <class Work> void run_together(Word*, int, Work& work) { work(0); }
#else
// Main function of a member's thread: runs posted jobs until the process ends.
inline void* serve(void* argument) {
    Member* const member = (Member*)argument;
    for (int idle = 0;; ++idle) {
        if (exchange_state(member, POSTED, WORKING)) {
            member->call(member->job, (int)member->number);
            set_state(member, WAITING);
            idle = 0;
        } else if (idle < POLLS_BEFORE_SLEEP) {
            sched_yield();
        } else {
            pthread_mutex_lock(member->lock);
            if (exchange_state(member, WAITING, ASLEEP))
                while (state_of(member) == ASLEEP) pthread_cond_wait(member->wake, member->lock);
            pthread_mutex_unlock(member->lock);
            idle = 0;
        }
    }
}

inline void start_members(int count, Word* team) {
    for (int m = 0; m < count; ++m) {
        Member* const member = (Member*)team + m;
        if (!exchange_state(member, GONE, CLAIMED)) continue;
        pthread_mutex_init(member->lock, nullptr);
        pthread_cond_init(member->wake, nullptr);
        set_state(member, WAITING);
        unsigned long id;
        if (pthread_create(&id, nullptr, serve, member) == 0) pthread_detach(id);
        else set_state(member, GONE);
    }
}

// Calls work(number) on up to ``threads`` threads; the caller is number 0. Returns when all calls that began have
// returned. A thread that is busy or late does not take part: the others do its work.
template <class Work> void run_together(Word* team, int threads, Work& work) {
    Member* claimed[MOST_THREADS];
    int count = 0;
    for (int m = 0; m < MOST_THREADS && count < threads - 1; ++m) {
        Member* const member = (Member*)team + m;
        if (state_of(member) == GONE) break;
        const bool asleep = exchange_state(member, ASLEEP, CLAIMED);
        if (!asleep && !exchange_state(member, WAITING, CLAIMED)) continue;
        claimed[count++] = member;
        member->call = [](void* job, int number) { (*(Work*)job)(number); };
        member->job = &work;
        member->number = count;
        if (asleep) pthread_mutex_lock(member->lock);
        set_state(member, POSTED);
        if (!asleep) continue;
        pthread_mutex_unlock(member->lock);
        pthread_cond_signal(member->wake);
    }
    work(0);
    // polling a member's state is faster than sleeping until it ends
    for (int t = 0; t < count; ++t)
        while (!exchange_state(claimed[t], POSTED, WAITING) && state_of(claimed[t]) == WORKING) sched_yield();
}
#endif

// Calls visit(i) for each of ``count`` items. Threads take ``share`` items at a time.
template <class Visit> void share_items(Word* team, int threads, int count, int share, Visit visit) {
    int next = 0;
    auto work = [&](int) {
        for (;;) {
            const int first = share * __atomic_fetch_add(&next, 1, __ATOMIC_RELAXED);
            if (first >= count) return;
            for (int i = first; i < count && i < first + share; ++i) visit(i);
        }
    };
    run_together(team, threads, work);
}

constexpr int MOST_PASSES = 16;
// Makes passes ``first`` to ``last`` − 1, one after the other. A pass has items(pass) items; make_pass(pass, i) handles
// ``width`` of them from item i on. Threads take chunks of items and wait at the end of each pass.
template <class Items, class MakePass>
void run_passes(Word* team, int threads, int first, int last, Items items, int width, MakePass make_pass) {
    const int taken_at_once = 4 * width;
    auto chunks_of = [&](int pass) { return (items(pass) + taken_at_once - 1) / taken_at_once; };
    auto make_chunk = [&](int pass, int chunk) {
        const int count = items(pass), begin = chunk * taken_at_once;
        const int end = begin + taken_at_once < count ? begin + taken_at_once : count;
        for (int i = begin; i < end; i += width) make_pass(pass, i);
    };
    // the caller takes chunks from the front, the others from the back, so that their caches often hold the data
    int taken[MOST_PASSES] = {}, from_front[MOST_PASSES] = {}, from_back[MOST_PASSES] = {}, done[MOST_PASSES] = {};
    auto work = [&](int member) {
        for (int pass = first; pass < last; ++pass) {
            const int chunks = chunks_of(pass);
            while (__atomic_fetch_add(&taken[pass], 1, __ATOMIC_RELAXED) < chunks) {
                const int n =
                    __atomic_fetch_add(member == 0 ? &from_front[pass] : &from_back[pass], 1, __ATOMIC_RELAXED);
                make_chunk(pass, member == 0 ? n : chunks - 1 - n);
                __atomic_fetch_add(&done[pass], 1, __ATOMIC_RELEASE);
            }
            while (__atomic_load_n(&done[pass], __ATOMIC_ACQUIRE) < chunks) yield_thread();
        }
    };
    run_together(team, threads, work);
}

// The same, for passes that all have ``count`` items.
template <class MakePass>
void run_passes(Word* team, int threads, int first, int last, int count, int width, MakePass make_pass) {
    run_passes(team, threads, first, last, [=](int) { return count; }, width, make_pass);
}
}
#endif
